"""Driver of the Novint Falcon, over libusb.

Other devices and the system's nodes (`drivers.system`) are elsewhere.
"""
