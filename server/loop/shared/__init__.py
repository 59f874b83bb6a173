"""Memory that the loop shares with Python: records on their way out, and what wakes who reads them.

No lock, and nobody waits: one writer, and one reader.
"""
