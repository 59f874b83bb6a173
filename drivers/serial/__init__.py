"""Boards on a serial port: one whose frames a rig describes, and WoodenHaptics' third generation, which sends text.

A rig's keys are in `options`, described frames in `packets`, the text of a frame in `frames`, the system's port in
`port`, the exchange of a tick in `exchange`; `device` puts them together.

What every board on a file descriptor does is not in here but in `drivers.conversation`.
"""
