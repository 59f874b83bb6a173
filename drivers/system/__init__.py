"""What the operating system knows of devices: what is attached, whose it is, its node opened for one process alone.

Nothing of any device's protocol.
"""
