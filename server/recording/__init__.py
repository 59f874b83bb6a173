"""Recordings of runs as MCAP files: what is in one, how it is written while the loop runs, read, summed up, compared.

Nothing of sockets and nothing of devices: ticks and events come in as records and maps.
"""
