"""Operating system's view of devices: attached devices, their drivers, permissions, and exclusive opening of nodes.

Nothing here depends on the protocol of a device.
"""
