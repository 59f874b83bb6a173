"""Compilation of kernels by numba for the servo loop: options and cache, dispatch, memory, arrays, atomics, a sequence
lock, and calls of C functions.

Nothing of geometry or contact.
"""
