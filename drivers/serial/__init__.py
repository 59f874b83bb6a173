"""Boards on a serial port: frames described by a rig, or the text of WoodenHaptics' third generation.

`options` has the configuration, `packets` the described frames, `frames` the text frames, `port` the system's port,
`queue` its unsent frames, `exchange` one tick, and `device` the device.

The part that all boards on a file descriptor share is in `drivers.board_exchange`, that of boards which a rig describes
in `drivers.described_board`.
"""
