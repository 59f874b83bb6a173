"""Devices of 3D Systems (Touch, Touch X; PHANToM Omni, Desktop, Premium) through the maker's library.

`models` has the limits of each device, `library` loads and declares the maker's functions, `scheduler` is the library's
thread, `exchange` has the functions of that thread and of the servo loop, and `device` opens, calibrates, stops and
closes.

The maker's library is not included: it is loaded when a device is opened, and may be missing.
"""
