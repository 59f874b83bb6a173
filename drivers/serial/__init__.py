"""Boards on a serial port: frames described by a rig, or the text of WoodenHaptics' third generation.

The part that all boards on a file descriptor share is in `drivers.board_exchange`.
"""
