"""Bridges to other programs: Foxglove and Rerun show a run, Gymnasium environments train agents on it.

Thin layers over the programs' libraries, which are extras and imported late. Contains no wire format: that is in `wire`
and `gateway`.
"""
