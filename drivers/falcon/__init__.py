"""The Novint Falcon, over libusb.

A rig's keys are in `options`, the bytes in `packets`, the mechanism in `delta`, the serial chip and the bus in
`usb`, the start of the device's processor in `firmware`, the exchange of a tick in `exchange`; `device` puts them
together.

Nothing here is of another device, nor of the system's nodes (`drivers.system`).
"""
