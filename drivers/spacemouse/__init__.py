"""A puck of 3Dconnexion that moves the fingertip: its reports and its motion in `puck`, the rest in `device`.

No force: what is written to it is kept, and goes nowhere. A hand led by a puck is in `drivers.simulated`.
"""
