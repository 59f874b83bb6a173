"""3Dconnexion puck that moves the fingertip: reports and motion in `puck`, device contract in `device`.

It displays no force; written wrenches are only logged. `drivers.simulated` contains a hand led by a puck.
"""
