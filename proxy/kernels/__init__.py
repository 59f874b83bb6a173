"""Numeric core: nopython functions of scalars and tuples. `step` computes one tick, in the order of its equations.

No allocation, no exceptions, and no imports except numerics and each other.
"""
