"""Driver in plain Python: ctypes converts two methods to C functions, which the servo loop calls in every tick.

    python examples/my_driver_python.py [TICKS]     # runs the daemon with it, and prints the jitter of the ticks

For devices with a Python library, and for experiments with code. In every tick the loop waits for Python's interpreter
lock, which other threads of the process may hold for 5 ms (`sys.getswitchinterval`). So ticks are regular only while no
other thread computes: the program runs once without and once with a busy thread. Not suitable for a device with force;
`my_driver_numba.py` is the same device without the lock.
"""

import ctypes
import math
import sys
import threading
import traceback
from collections.abc import Callable
from typing import Annotated, Any

import numpy as np

from softfinger.config.limits import Range
from softfinger.config.load import load_rig, load_scene
from softfinger.config.schema import Rig, Table, within
from softfinger.drivers import registry
from softfinger.drivers.base import OK, PROTOCOL, WITHHELD, Device, DeviceInfo, DeviceIO
from softfinger.proxy.records import Records
from softfinger.server.app import Daemon
from softfinger.server.services.records import Sink

C_FUNCTION = ctypes.CFUNCTYPE(ctypes.c_int64, ctypes.c_int64, ctypes.POINTER(ctypes.c_double))
HOLD_N_PER_M = 3000.0  # stiffness of the simulated hand that holds the fingertip


class Options(Table, frozen=True, kw_only=True):
    """Keys of [device]."""

    depth_m: Annotated[float, within(Range(0.0, 0.005, "half a fingertip"), "press depth of the hand", 0.001)] = 0.001


class MyDevice(Device):
    """A 10 mm fingertip that moves up and down at z = 0, and yields to the force."""

    def __init__(self, options: Options, rate_hz: float) -> None:
        self.info = DeviceInfo("my-device", 3, 3, 12.0, 0.3, 2000.0, 10.0, (-0.1,) * 3, (0.1,) * 3)
        self._depth, self._period, self._reads = options.depth_m, 1.0 / rate_hz, 0
        self._force, self._armed = (0.0, 0.0, 0.0), True
        # Must live as long as the device: the loop only has their addresses.
        self._functions = [C_FUNCTION(self._told(method)) for method in (self.read, self.write)]

    @staticmethod
    def _told(method: Callable[[Any], int]) -> Callable[[int, Any], int]:
        """Convert exceptions of `method` to a status: ctypes would print them and return 0, which means success."""

        def called(handle: int, numbers: Any) -> int:
            try:
                return method(numbers)
            except Exception:
                traceback.print_exc()
                return PROTOCOL

        return called

    def read(self, sample: Any) -> int:
        time = self._reads * self._period
        self._reads += 1
        height = 0.010 - self._depth * math.sin(2.0 * math.pi * time)
        place = 0.0, 0.0, height + self._force[2] / HOLD_N_PER_M
        for i, number in enumerate((*place, 1.0, 0.0, 0.0, 0.0, time, 0.0, 0.0)):
            sample[i] = number
        return OK

    def write(self, wrench: Any) -> int:
        if not self._armed:
            return WITHHELD if any(wrench[0:6]) else OK
        self._force = wrench[0], wrench[1], wrench[2]
        return OK

    def io(self) -> DeviceIO:
        read, write = (ctypes.cast(function, ctypes.c_void_p).value or 0 for function in self._functions)
        return DeviceIO(read, write, 1)  # the methods have `self`, so the handle may be any number except 0

    def stop(self) -> None:
        self._armed, self._force = False, (0.0, 0.0, 0.0)

    def close(self) -> None:
        self.stop()


def open_device(options: Options, rate_hz: float) -> MyDevice:
    return MyDevice(options, rate_hz)


def ticks_on(rig: Rig, count: int) -> Records:
    """Return the records of a daemon that runs for `count` ticks."""
    taken: list[np.ndarray] = []
    keep = Sink("figures", lambda rows, lost: taken.append(rows.copy()))
    with Daemon(rig, load_scene("paper-plane"), count, sinks=[keep]) as daemon:
        daemon.start()
        daemon.wait()
    return Records(np.concatenate(taken))


def compute(until: threading.Event) -> None:
    while not until.is_set():
        sum(range(1000))


def main(count: int = 2000) -> None:
    registry.add("my-driver", sys.modules[__name__])
    endpoints = {"telemetry.endpoint": "tcp://127.0.0.1:*", "commands.endpoint": "off"}
    rig = load_rig("replay", {"device.driver": "my-driver", **endpoints})
    for busy in (False, True):
        over = threading.Event()
        if busy:
            threading.Thread(target=compute, args=[over], daemon=True).start()
        records = ticks_on(rig, count)
        over.set()
        p50, p99 = np.percentile(1e3 * np.diff(records["timestamp"]), [50, 99])
        print(
            f"{len(records)} ticks {'with a busy thread' if busy else 'alone'}, {p50:.2f} ms apart at the median, ",
            end="",
        )
        print(f"{p99:.2f} ms for one in a hundred; largest force {records['force'][:, 2].max():.2f} N")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
