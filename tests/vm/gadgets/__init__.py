"""Devices of the guest: the emulated mechanisms behind its kernel's own USB and HID. Python's library alone."""
