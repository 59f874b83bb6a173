"""Gateway: a process that forwards telemetry and commands over ZeroMQ sockets, to other machines with CURVE keys.

Contains no servo and no device: the effects of a misbehaving peer are limited to the process.
"""
