"""Ring buffers from the servo loop to its readers, and the wait for their eventfd.

No lock; each buffer has a single writer, which never waits.
"""
