"""The wire: what is published, how it is encoded, and how it is received again.

Nothing here is waited for by the loop.
"""
