"""Simulated handle with motors, encoders and a hand: physics in `plant` and `axis`, device contract in `device`.

Nothing here uses a clock or a thread: a read advances one period, so that a run is reproducible to the bit.
"""
