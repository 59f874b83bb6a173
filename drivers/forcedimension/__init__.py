"""Devices of Force Dimension (omega, delta, sigma, lambda) through the maker's library, found at run time.

`library` loads and declares the maker's functions, `selection` has the limits of each device and selects one,
`exchange` has the functions of the servo loop and their memory, and `device` opens, configures, stops and closes.

The maker's library is not included: it is loaded when a device is opened, and may be missing.
"""
