"""What makes numba compile kernels as the loop needs: options and cache, dispatch, memory, arrays, atomics,
a sequence lock, C calls.

Nothing of geometry or contact.
"""
