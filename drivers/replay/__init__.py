"""A recording as a device, in `device`: it senses the recorded poses and keeps what is written to it.

Nothing of files: a recording is read by `drivers.poses` and brought to the servo's rate by `drivers.resample`.
"""
