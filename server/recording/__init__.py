"""Recordings of runs as MCAP files: format, writing during a run, reading, summary, comparison, and their verbs.

Contains no devices: ticks and events arrive as records and maps, in `live` from the wire.
"""
