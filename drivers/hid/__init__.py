"""Devices on USB HID: the WoodenHaptics family, and devices with reports described by a rig.

`options` has the configuration, `reports.toml` the shipped formats, and `exchange` one tick. `link` opens the device:
through the system's hidraw node, or on the USB bus without one, with `report_threads` if threads carry the reports.
`device` is the device.

The part that all boards on a file descriptor share is in `drivers.board_exchange`, that of boards which a rig describes
in `drivers.described_board`.
"""
