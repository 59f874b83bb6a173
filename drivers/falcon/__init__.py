"""Driver of the Novint Falcon, over libusb.

`options` has the configuration, `packets` the bytes, `usb` the bus and the serial chip, `firmware` the start of the
device's processor, `conversion` the mechanism and the conversion of packets, `block` the memory of the exchange,
`exchange` one tick, and `device` the device.
"""
