"""What stands between kernels and numba: all that numba does not document, and what is done with kernels just now.

No kernel, and no options: those are in `jit.py`.
"""
