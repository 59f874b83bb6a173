"""Recordings of runs as MCAP files: their format, writing during a run, reading, summary and comparison.

Contains no sockets and no devices: ticks and events arrive as records and maps.
"""
