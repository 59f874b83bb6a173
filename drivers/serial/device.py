"""A device on a serial port behind the contract: woken when it is opened, and zero force on every way out."""

from __future__ import annotations

import ctypes
import logging
import time
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import DeviceError, DeviceLost, DeviceTimeout
from softfinger.drivers.base import LOST, SAMPLE_SIZE, TIMEOUT, Device, DeviceInfo, DeviceIO
from softfinger.drivers.serial import exchange, frames
from softfinger.drivers.serial.options import Options
from softfinger.drivers.serial.port import close_port, open_port
from softfinger.proxy.kernels.pack import flatten

log: Final = logging.getLogger(__name__)

TORQUE_MAX_NM: Final = 1e2
"""No motor turns the handle, but the torque is taken: it belongs to the contact and to telemetry."""
STOP_WAIT_S: Final = 1.0
"""How long a stop waits for a port that takes nothing."""


class SerialDevice(Device):
    """An open device on the file descriptor `fd` of its port, which it owns from now on.

    Raises DeviceTimeout when it does not wake up, DeviceError when what it says is no frame, DeviceLost when it goes.
    """

    def __init__(self, options: Options, fd: int, path: str) -> None:
        self._options = options
        self._word = np.zeros(exchange.WORDS, dtype=np.int64)
        self._in = np.full(frames.LOOKBACK + exchange.CHUNK, frames.NEWLINE, np.uint8)
        self._out = np.zeros(frames.FRAME_BYTES, np.uint8)
        self._scratch, self._values = np.zeros(frames.NUMBERS), np.zeros(frames.NUMBERS)
        self._sample = np.zeros(SAMPLE_SIZE)
        origin, turned = options.mounting.frame()
        self._model = flatten(exchange.Model(origin, turned, options.force_max_n))
        self._wire(fd)
        x, y, z = origin
        r = options.workspace_radius_m
        self.info = DeviceInfo(
            name=f"serial {options.vendor_id:04x}:{options.product_id:04x} at {path}",
            sensed_dof=5,  # nobody senses the turn about the handle's own axis
            actuated_dof=3,
            force_max_n=options.force_max_n,
            torque_max_nm=TORQUE_MAX_NM,
            stiffness_max_n_per_m=options.stiffness_max_n_per_m,
            damping_max_ns_per_m=options.damping_max_ns_per_m,
            workspace_min_m=(x - r, y - r, z - r),
            workspace_max_m=(x + r, y + r, z + r),
        )
        try:
            self._wake()
        except BaseException:
            self.close()
            raise

    def _wire(self, fd: int) -> None:
        word, options = self._word, self._options
        word[exchange.FD] = fd
        word[exchange.ARMED] = 1
        word[exchange.OPENED_AT] = time.monotonic_ns()
        word[exchange.QUIET] = round(options.quiet_s * 1e9)
        word[exchange.KICK] = round(options.kick_s * 1e9)
        word[exchange.TIMEOUT_AFTER] = round(options.timeout_s * 1e9)
        word[exchange.ASKED_AT] = -exchange.ANSWERED  # nothing has been asked
        word[exchange.WAKE] = frames.NEWLINE
        arrays: list[NDArray[Any]] = [
            self._in, self._out, self._scratch, self._values, self._sample, self._model
        ]  # fmt: skip
        word[exchange.IN_BUFFER : exchange.MODEL + 1] = [array.ctypes.data for array in arrays]

    def _wake(self) -> None:
        """Kick the device until it sends a frame: a board that has just been plugged in takes a while to start."""
        sample = (ctypes.c_double * SAMPLE_SIZE)()
        until = time.monotonic() + self._options.wake_s
        while (status := exchange.read.ctypes(self._word.ctypes.data, sample)) < 0:
            if status == LOST:
                raise DeviceLost(f"{self.info.name} is gone: plug it in again")
            if time.monotonic() < until:
                continue
            if status == TIMEOUT:
                raise DeviceTimeout(
                    f"{self.info.name} sends no frame within {self._options.wake_s:g} s: check its power and its "
                    "firmware, or give it more time with wake_s"
                )
            raise DeviceError(
                f"{self.info.name} sends no frame of eight numbers in 64 bytes ({self.reason()}): is it this device, "
                "and its third generation?"
            )

    def io(self) -> DeviceIO:
        return DeviceIO(exchange.read.address, exchange.write.address, self._word.ctypes.data)

    def stop(self) -> None:
        until = time.monotonic() + STOP_WAIT_S
        while not exchange.silence.ctypes(self._word.ctypes.data):
            if time.monotonic() > until:
                log.error("%s: the port has taken nothing for %g s; no zero can follow", self.info.name, STOP_WAIT_S)
                return
            time.sleep(0.0001)

    def close(self) -> None:
        self.stop()
        fd = int(self._word[exchange.FD])
        self._word[exchange.FD] = -1
        if fd >= 0:
            close_port(fd)

    def reason(self) -> str:
        word = self._word
        if word[exchange.BYTES] - word[exchange.UNDERSTOOD_AT] < exchange.ANSWERED:
            return ""
        return f"its last bytes are {self._in[: frames.LOOKBACK].tobytes()!r}"

    def counts(self) -> dict[str, int]:
        return {name: int(self._word[at]) for at, name in enumerate(exchange.COUNTERS)}


def open_device(options: Options, rate_hz: float) -> SerialDevice:
    """Open the device a rig names; DeviceError and its kinds when it cannot be used. Any `rate_hz` will do."""
    return SerialDevice(options, *open_port(options))
