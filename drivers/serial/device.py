"""A device on a serial port behind the contract: woken when it is opened, and zero force on every shutdown path."""

from __future__ import annotations

import ctypes
import logging
import time
from typing import Final

from softfinger.config.errors import DeviceError, DeviceLost, DeviceTimeout
from softfinger.drivers.base import LOST, SAMPLE_SIZE, TIMEOUT, Device, DeviceIO, LastWord
from softfinger.drivers.block import Block
from softfinger.drivers.conversation import TALK, Times, begin, info_of
from softfinger.drivers.serial import exchange, frames
from softfinger.drivers.serial.exchange import AT
from softfinger.drivers.serial.options import Options
from softfinger.drivers.serial.port import close_port, open_port
from softfinger.proxy.kernels.jit.pack import flatten

log: Final = logging.getLogger(__name__)

STOP_WAIT_S: Final = 1.0
"""How long a stop waits for a port that takes nothing."""


class SerialDevice(Device):
    """An open device on the file descriptor `fd` of its port, which it owns from now on.

    Raises DeviceTimeout when it does not wake up, DeviceError when what it says is no frame, DeviceLost when it goes.
    """

    def __init__(self, options: Options, fd: int, path: str) -> None:
        self._options, self._path = options, path
        origin, turned = options.mounting.frame()
        self._block = self._make_block(fd, exchange.Model(origin, turned, options.force_max_n))
        name = f"serial {options.vendor_id:04x}:{options.product_id:04x} at {path}"
        self.info = info_of(options, name, sensed_dof=5)  # nobody senses the turn about the handle's own axis
        try:
            self._wake()
        except BaseException:
            self.close()
            raise

    def _make_block(self, fd: int, model: exchange.Model) -> Block:
        block, options = Block(TALK, AT), self._options
        spans = Times(options.quiet_s, options.kick_s, kick_awaiting=options.kick_s, timeout=options.timeout_s)
        begin(block, fd, spans, answer=exchange.ANSWERED)
        block.word[AT.asked_at] = -exchange.ANSWERED  # nothing has been asked
        block.word[AT.newline] = frames.NEWLINE
        block.octets(AT.incoming, frames.LOOKBACK)[:] = frames.NEWLINE
        block.numbers(AT.model, exchange.MODEL_SIZE)[:] = flatten(model)
        return block

    def _wake(self) -> None:
        """Kick the device until it sends a frame: a board that has just been plugged in takes a while to start."""
        sample = (ctypes.c_double * SAMPLE_SIZE)()
        until = time.monotonic() + self._options.wake_s
        while (status := exchange.read.ctypes(self._block.handle, sample)) < 0:
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
        return DeviceIO(exchange.read.address, exchange.write.address, self._block.handle)

    def arm(self) -> None:
        """Wake the board again and wait for a frame of now: minutes may have passed since the port was opened."""
        self._block.word[TALK.sensed] = 0
        self._wake()

    def stop(self) -> None:
        until = time.monotonic() + STOP_WAIT_S
        while not exchange.silence.ctypes(self._block.handle):
            if time.monotonic() > until:
                log.error("%s: the port has taken nothing for %g s; no zero can follow", self.info.name, STOP_WAIT_S)
                return
            time.sleep(0.0001)

    def close(self) -> None:
        self.stop()
        fd = int(self._block.word[TALK.fd])
        self._block.word[TALK.fd] = -1
        if fd >= 0:
            close_port(fd)

    def reason(self) -> str:
        if self._block.word[TALK.misread] < exchange.ANSWERED:
            return ""
        return f"its last bytes are {self._block.octets(AT.incoming, frames.LOOKBACK).tobytes()!r}"

    def last_word(self) -> LastWord:
        return LastWord(self._path, int(self._block.word[TALK.fd]), frames.ZERO)

    def counts(self) -> dict[str, int]:
        return self._block.counts()


def open_device(options: Options, rate_hz: float) -> SerialDevice:
    """Open the device a rig names; DeviceError and its kinds when it cannot be used. Any `rate_hz` will do."""
    return SerialDevice(options, *open_port(options))
