"""Stick-slip with rolling and sliding, laws of friction and torsion, limit surface, and contact patch.

Nothing of shapes or poses: the input is one contact with its normal force and wind-up.
"""
