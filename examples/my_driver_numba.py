"""Driver with two functions compiled by numba: the loop needs neither interpreter nor lock, so no tick is late.

    python examples/my_driver_numba.py              # runs the daemon with it for two seconds

The same device as in `my_driver_python.py`. The handle is the address of a memory block that the two functions and the
class share; a device in C works in the same way, with functions of its library. Installation of a driver for all rigs:
docs/devices/writing-a-driver.md.
"""

import math
import sys
from typing import Annotated, Any, NamedTuple

from softfinger.config.limits import Range
from softfinger.config.schema import Table, within
from softfinger.drivers import registry
from softfinger.drivers.base import OK, WITHHELD, Device, DeviceInfo, DeviceIO
from softfinger.drivers.block import Block, counter, lay_out, numbers, word
from softfinger.drivers.system.libc import IO_SIGNATURE
from softfinger.proxy.kernels.jit.decorators import c_function
from softfinger.proxy.kernels.jit.memory import float64_at, int64_at
from softfinger.server.cli import main

HOLD_N_PER_M = 3000.0  # stiffness of the simulated hand that holds the fingertip
DEPTH, PERIOD = 0, 1  # indices in `given`


class Options(Table, frozen=True, kw_only=True):
    """Keys of [device]."""

    depth_m: Annotated[float, within(Range(0.0, 0.005, "half a fingertip"), "press depth of the hand", 0.001)] = 0.001


class Fields(NamedTuple):
    """Fields of the block."""

    reads: Annotated[int, counter("poses read")]
    armed: Annotated[int, word("whether force is displayed")]
    given: Annotated[int, numbers("depth (m) and period (s)", 2)]
    force: Annotated[int, numbers("on the hand (N)", 3)]


AT = lay_out(Fields)


@c_function(IO_SIGNATURE)
def read(handle: int, sample: Any) -> int:
    words, given, force = int64_at(handle), float64_at(handle + 8 * AT.given), float64_at(handle + 8 * AT.force)
    time = words[AT.reads] * given[PERIOD]
    words[AT.reads] += 1
    for i in range(10):
        sample[i] = 0.0
    sample[2] = 0.010 - given[DEPTH] * math.sin(2.0 * math.pi * time) + force[2] / HOLD_N_PER_M
    sample[3] = 1.0
    sample[7] = time
    return OK


@c_function(IO_SIGNATURE)
def write(handle: int, wrench: Any) -> int:
    force = float64_at(handle + 8 * AT.force)
    some = False
    for i in range(3):
        some = some or wrench[i] != 0.0
    if int64_at(handle)[AT.armed] == 0:
        return WITHHELD if some else OK
    for i in range(3):
        force[i] = wrench[i]
    return OK


class MyDevice(Device):
    """A 10 mm fingertip that moves up and down at z = 0, and yields to the force."""

    def __init__(self, options: Options, rate_hz: float) -> None:
        self.info = DeviceInfo("my-device", 3, 3, 12.0, 0.3, 2000.0, 10.0, (-0.1,) * 3, (0.1,) * 3)
        self.block = Block(AT)  # valid for the lifetime of this object
        self.block.numbers(AT.given, 2)[:] = options.depth_m, 1.0 / rate_hz
        self.block.word[AT.armed] = 1

    def io(self) -> DeviceIO:
        return DeviceIO(read.address, write.address, self.block.handle)

    def counts(self) -> dict[str, int]:
        return self.block.counts()

    def stop(self) -> None:
        self.block.word[AT.armed] = 0
        self.block.numbers(AT.force, 3)[:] = 0.0

    def close(self) -> None:
        self.stop()


def open_device(options: Options, rate_hz: float) -> MyDevice:
    return MyDevice(options, rate_hz)


if __name__ == "__main__":
    registry.add("my-driver", sys.modules[__name__])
    endpoints = ["--endpoint", "tcp://127.0.0.1:*", "--commands", "off"]
    sys.exit(main(["run", "--device", "my-driver", "--duration", "2", *endpoints]))
