"""Contact model: scenes built from configuration, the record of a tick, an engine for Python, and the kernels.

Nothing of devices, clocks or sockets.
"""
