"""Devices on USB HID: WoodenHaptics and its relatives, and any device whose reports its rig describes.

A rig's keys are in `options`, the bytes in `reports`, the arm in `chain`, the exchange of a tick in `exchange`.
The way to the device is chosen in `link`: the system's node in `node`, or `usb` without one, and `pump` where threads
carry the reports. `device` puts them together.

What every board on a file descriptor does is not in here but in `drivers.conversation`.
"""
