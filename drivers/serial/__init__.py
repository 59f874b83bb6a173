"""WoodenHaptics' third generation: a board on a serial port that knows its own kinematics.

What a rig may say is in `options`, the text of a frame in `frames`, the system's port in `port`, the exchange of a
tick in `exchange`; `device` puts them together.
"""

from softfinger.drivers.serial.device import SerialDevice, open_device
from softfinger.drivers.serial.options import Options

__all__ = ["Options", "SerialDevice", "open_device"]
