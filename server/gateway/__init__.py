"""The gateway: a process that hands telemetry and commands on, by libzmq's own sockets, to other machines by CURVE.

No servo and no device: what a peer does to it stays in its process.
"""
