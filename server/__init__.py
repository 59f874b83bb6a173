"""The program: the command line, the daemon, and the loop that renders.

No physics and no vendor's protocol: those are in `proxy` and `drivers`. Nothing here imports `tools`.
"""
