"""What is done otherwise than numba does it, so that kernels compile in half the time: passes, and code for callers.

No kernel, and no options: those are in `jit.py`.
"""
