"""Devices of the guest: emulated mechanisms behind its kernel's USB and HID. They need only Python's standard
library."""
