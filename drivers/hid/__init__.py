"""Devices on USB HID: the WoodenHaptics family, and devices with reports described by a rig.

The part that all boards on a file descriptor share is in `drivers.board_exchange`.
"""
