"""What sends every tick without the interpreter: messages as templates, the newest of them, the peers' sockets.

Nothing here reads a byte of a peer: who it is, and what it may ask for, is `fanout.py`'s.
"""
