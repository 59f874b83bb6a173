"""Interface to numba: all uses of its undocumented parts, and the progress of compilation.

No kernels and no options (`decorators.py`).
"""
