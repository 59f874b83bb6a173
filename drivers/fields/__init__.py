"""Numbers in the bytes of a device: configuration in `options`, reading and writing in `table`.

Drivers carry the bytes, as reports or frames.
"""
