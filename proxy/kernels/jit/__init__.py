"""Compilation of kernels by numba: options, cache, dispatch, memory, arrays, atomics, sequence lock, C calls.

Nothing of geometry or contact. A kernel has one of these decorators:

    @jit                   called by kernels, compiled into them
    @entry                 called from Python
    @outlined              called by kernels, by address: too large to be compiled into each of them
    @outlined_where(f)     outlined for argument types for which `f` returns true, otherwise as @jit
    @c_function(signature) called by a C library, or by address
    @by_type               declares a kernel chosen by the type of its first argument: `.of(Kind)` implements it
    @by_type_with_default  the same; the declaration is the implementation for all other types

In all of them, a condition `x is None` or `isinstance(x, Kind)` on an argument or a field of one is evaluated at
compile time, and the code that is not reached is not compiled.
"""
