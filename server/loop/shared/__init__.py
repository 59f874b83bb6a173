"""Memory that the loop shares with Python: records on their way out.

No lock, and nobody waits: one writer, and one reader.
"""
