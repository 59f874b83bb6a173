"""What other programs make of a run: Foxglove and Rerun show it, Gymnasium learns from it.

Thin, on their own libraries, which are extras and imported late. No wire of our own: that is in `wire` and `gateway`.
"""
