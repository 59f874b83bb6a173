"""A handle with its motors, its encoders and a hand on it, computed: the plant in `plant` of `axis`, behind `device`.

Nothing that knows of a clock or a thread: a read is a period, so that a run is reproducible to the bit.
"""
