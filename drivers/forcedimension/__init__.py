"""Devices of Force Dimension (omega, delta, sigma, lambda) through the maker's library, found at run time.

The maker's library is not included: it is loaded when a device is opened, and may be missing.
"""
