"""Devices of the guest: emulated mechanisms behind its kernel's USB and HID, with only the standard library."""
