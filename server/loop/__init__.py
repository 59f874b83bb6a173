"""Servo loop: tick, guard, limits, real-time settings and the memory shared with other parts of the daemon.

Contains no socket, file or terminal.
"""
