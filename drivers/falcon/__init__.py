"""Driver of the Novint Falcon, over libusb.

`options` has the configuration, `packets` the bytes, `delta` the mechanism, `usb` the bus and the serial chip,
`firmware` the start of the device's processor, `reply` the conversion of packets, `exchange` one tick, and `device` the
device.

Other devices and the system's nodes (`drivers.system`) are elsewhere.
"""
