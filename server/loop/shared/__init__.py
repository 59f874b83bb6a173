"""Memory that the loop shares with Python: records on their way out, parameters on their way in.

No lock, and nobody waits: each has one writer and one reader.
"""
