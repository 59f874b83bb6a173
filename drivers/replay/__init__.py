"""Recording as a device, in `device`: reads return recorded poses, and written wrenches are logged.

Files are read by `drivers.poses`, and resampled to the servo's rate by `drivers.resample`.
"""
