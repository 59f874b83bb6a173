"""Compilation of kernels by numba: options, cache, dispatch, memory, arrays, atomics, sequence lock, C calls.

Nothing of geometry or contact.
"""
