"""Commands of the command line for other machines: forwarding of telemetry and commands, and creation of keys.

Contains no sockets: the gateway is in the folder above.
"""
