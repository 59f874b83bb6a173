"""Numbers in the bytes of a device: what a rig may say of them in `options`, read and written in `table`.

What carries the bytes, a report or a frame, belongs to the driver.
"""
