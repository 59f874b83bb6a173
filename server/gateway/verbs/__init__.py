"""What the command line does for other machines: hand telemetry and commands on, make keys.

No sockets: the gateway itself is beside this folder.
"""
