"""Devices of 3D Systems (Touch, Touch X; PHANToM Omni, Desktop, Premium) through the maker's library.

The maker's library is not included: it is loaded when a device is opened, and may be missing.
"""
