"""Devices: one contract (`base`), one file per device, found by name (`registry`)."""
