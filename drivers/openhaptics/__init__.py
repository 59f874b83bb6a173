"""Devices of 3D Systems (Touch, Touch X; PHANToM Omni, Desktop, Premium) through the maker's library.

`library` has the maker's functions and the limits of each device, `scheduler` is the library's thread, `exchange` has
the functions of that thread and of the servo loop, `block` their memory, and `device` opens, calibrates, stops and
closes.

The maker's library is not included: it is loaded when a device is opened, and may be missing.
"""
