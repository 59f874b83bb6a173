"""Sticking and slipping: the rolling / sliding machine, and the laws of friction and torsion it asks.

Nothing of shapes or places: a contact, its normal force and what it has been wound by are all it sees.
"""
