"""The numeric core: nopython functions of scalars and tuples. `step` is one tick, in the order of its equations.

No allocation, no exception, and no import but of numerics and of each other.
"""
