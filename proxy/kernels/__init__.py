"""The numeric core: nopython functions of scalars and tuples, without allocation and without exceptions."""
