"""What hands every tick on without the interpreter: the thread that does, and the memory in which it does.

No sockets, and nothing that a peer could reach.
"""
