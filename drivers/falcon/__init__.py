"""The Novint Falcon, over libusb.

What a rig may say is in `options`, the bytes in `packets`, the mechanism in `delta`, the serial chip and the bus in
`usb`, the start of the device's processor in `firmware`, the exchange of a tick in `exchange`; `device` puts them
together.
"""

from softfinger.drivers.falcon.device import Falcon, identify, open_device
from softfinger.drivers.falcon.options import Options

__all__ = ["Falcon", "Options", "identify", "open_device"]
