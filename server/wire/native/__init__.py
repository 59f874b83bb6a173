"""Relay: the thread that passes on every tick without the interpreter, and the shared memory it writes.

Contains no sockets, and no code that a peer could reach.
"""
