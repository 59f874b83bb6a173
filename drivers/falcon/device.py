"""Falcon: memory of the exchange, homing, and zero force on every shutdown path."""

from __future__ import annotations

import ctypes
import logging
import time
from functools import partial
from typing import Any, ClassVar, Final

import numpy as np

from softfinger.config.errors import DeviceError, DeviceLost, DeviceTimeout
from softfinger.drivers.base import SAMPLE_SIZE, TIMEOUT, ModelLimits, ZeroCommand, make_info
from softfinger.drivers.block import Block, BlockDevice
from softfinger.drivers.closeable import undo_on_error
from softfinger.drivers.falcon import exchange, firmware, packets, usb
from softfinger.drivers.falcon.block import AT
from softfinger.drivers.falcon.conversion import HOME
from softfinger.drivers.falcon.options import COUNTS_PER_NM, Options
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.drivers.system.makers_library import find_address

log: Final = logging.getLogger(__name__)

LIMITS: Final = ModelLimits(8.0, 0.0, 3000.0, 20.0, 0.04)
"""Recommended maxima of the device."""
STOP_WAIT_S: Final = 1.0
"""Maximum duration of a stop. A packet that hangs is cancelled after `STOP_HANG_NS`, then a zero is sent."""
PAUSE_S: Final = 0.001
"""Pause between exchanges while homing."""

_TRANSFER_BULK: Final = 2
_COMPLETED: Final = 0
"""Status of a transfer that was completed, or never submitted."""


class Transfer(ctypes.Structure):
    """struct libusb_transfer."""

    _fields_: ClassVar[list[Any]] = [
        ("dev_handle", ctypes.c_void_p),
        ("flags", ctypes.c_uint8),
        ("endpoint", ctypes.c_ubyte),
        ("type", ctypes.c_ubyte),
        ("timeout", ctypes.c_uint),
        ("status", ctypes.c_int),
        ("length", ctypes.c_int),
        ("actual_length", ctypes.c_int),
        ("callback", ctypes.c_void_p),
        ("user_data", ctypes.c_void_p),
        ("buffer", ctypes.c_void_p),
        ("num_iso_packets", ctypes.c_int),
    ]


class Falcon(BlockDevice):
    """Open device, owner of a line to a device with running firmware. No force until `arm`."""

    _functions = exchange.read, exchange.write

    def __init__(self, options: Options, chip: usb.SerialChip) -> None:
        self._options, self._chip = options, chip
        self._block = Block(AT)
        self._word = self._block.word
        self.info = make_info(LIMITS, f"Novint Falcon {usb.IDS}", sensed_dof=3)
        with undo_on_error(self.close):
            self._set_up()
            self._wait_for_home()
            if options.counts_per_nm is None:
                log.warning(
                    "%s: force is not calibrated: %g motor counts per N m are assumed, but the true value may be "
                    "several times smaller or larger; set `counts_per_nm` in the rig (docs/devices/falcon.md)",
                    self.info.name, COUNTS_PER_NM,
                )  # fmt: skip
            self._word[AT.has_sample] = 0  # the first sample must be from the time of the servo loop

    def _set_up(self) -> None:
        word, options = self._word, self._options
        self._libusb = libusb = self._chip.libusb()
        call = libusb.library
        # pyusb has declared these already with its types: calls by address need none
        self._free = ctypes.CFUNCTYPE(None, ctypes.c_void_p)(find_address(call, "libusb_free_transfer"))
        allocate = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_int)(find_address(call, "libusb_alloc_transfer"))
        word[AT.context] = libusb.context
        self._block.set_functions(call)
        word[AT.kick] = round(options.kick_s * 1e9)
        word[AT.timeout_after] = round(options.timeout_s * 1e9)
        word[AT.opened_at] = time.monotonic_ns()
        numbers = self._block.numbers
        numbers(AT.centre, 3)[:] = options.centre_m
        gain = options.counts_per_nm or COUNTS_PER_NM
        numbers(AT.gain, 1)[:] = -gain if options.motors_reversed else gain
        numbers(AT.position, 3)[:] = HOME
        numbers(AT.sample + 3, 1)[:] = 1.0  # it senses no rotation
        at = self._block.handle
        word[AT.in_done] = word[AT.out_done] = 1  # not submitted
        for field, endpoint, flag, buffer, length in (
            (AT.transfer_in, usb.ENDPOINT_IN, AT.in_done, AT.buffer_in, packets.CHIP_BYTES),
            (AT.transfer_out, usb.ENDPOINT_OUT, AT.out_done, AT.buffer_out, packets.SIZE),
        ):
            transfer_at = allocate(0)
            if not transfer_at:
                raise DeviceError("libusb cannot allocate a transfer: close other programs")
            word[field] = transfer_at
            transfer = Transfer.from_address(transfer_at)
            transfer.dev_handle, transfer.endpoint, transfer.type = libusb.handle, endpoint, _TRANSFER_BULK
            transfer.callback, transfer.user_data = exchange.on_complete.address, at + 8 * flag
            transfer.buffer, transfer.length = at + 8 * buffer, length
        _active_blocks[at] = self._block
        word[AT.open] = 1
        if exchange.start_reading.ctypes(at) < 0:
            raise DeviceLost(f"{self.info.name} accepts no transfer (libusb error {word[AT.error]}): plug it in again")

    def _wait_for_home(self) -> None:
        """Wait until the device knows the zeros of its encoders: the user pulls the knob out and pushes it in."""
        word, read, write = self._word, exchange.read.ctypes, exchange.write.ctypes
        word[AT.lights] = packets.RED | packets.HOMING
        sample, zero = (ctypes.c_double * SAMPLE_SIZE)(), (ctypes.c_double * 6)()
        until, was_logged = time.monotonic() + self._options.homing_s, False
        while True:
            status = read(self._block.handle, sample)
            if status == TIMEOUT:
                raise DeviceTimeout(f"{self.info.name} does not answer: switch it off and on, then start again")
            if status < 0:
                raise DeviceLost(f"{self.info.name} is disconnected (status {status}): check USB cable and power")
            if word[AT.homed] == packets.HOMED:
                return
            if not was_logged:
                log.warning(
                    "%s: pull the knob out completely, then push it in, until the light is green", self.info.name
                )
                was_logged = True
            if time.monotonic() > until:
                raise DeviceTimeout(
                    f"{self.info.name} was not homed in {self._options.homing_s:g} s: pull the knob out all the way, "
                    "then push it in, until the red light turns green; `homing_s` in the rig gives more time"
                )
            write(self._block.handle, zero)
            time.sleep(PAUSE_S)

    def arm(self) -> None:
        # The device has no timeout: the light and the force of the last packet persist, here a zero.
        if not self._word[AT.stopped]:
            self._word[AT.lights] = packets.GREEN
            self._word[AT.armed] = 1

    def stop(self) -> None:
        if not self._word[AT.open]:
            return
        failure = ""
        if not self._call_until_done(exchange.disarm_and_zero, STOP_WAIT_S):
            failure = f"it has accepted no packet for {STOP_WAIT_S:g} s"
        elif self._word[AT.has_force] or Transfer.from_address(int(self._word[AT.transfer_out])).status != _COMPLETED:
            failure = self.reason() or "its last packet was not sent"
        self._report_zero_failure(failure)

    def close(self) -> None:
        if not self._word[AT.transfer_in]:
            self._chip.close()
            return
        self._word[AT.lights] = packets.RED
        self._word[AT.has_force] = 1  # so that the last zero and the light are sent in any case
        self.stop()
        if self._call_until_done(exchange.cancel_transfers, STOP_WAIT_S):
            for field in (AT.transfer_in, AT.transfer_out):
                if self._word[field]:
                    self._free(int(self._word[field]))
            _active_blocks.pop(self._block.handle, None)
        elif self._word[AT.open]:  # a thread is inside libusb and uses the transfers: free nothing
            log.error("%s: a call of libusb does not return: the device stays open", self.info.name)
            return
        else:  # closing removes them from libusb; they and the block are not freed
            log.error("%s: libusb does not cancel its transfers", self.info.name)
        self._word[AT.transfer_in] = self._word[AT.transfer_out] = 0
        self._chip.close()

    def reason(self) -> str:
        if self._word[AT.was_homed] and self._word[AT.homed] != packets.HOMED:
            return "it has lost its encoder zeros, possibly by a power failure: start again and home it"
        error = int(self._word[AT.error])
        return f"libusb's error {error}" if error else ""

    def zero_command(self) -> ZeroCommand:
        zero = np.zeros(packets.SIZE, np.uint8)
        packets.encode((0, 0, 0), packets.RED, zero)
        return ZeroCommand(self._chip.node, None, zero.tobytes(), usb.INTERFACE, usb.ENDPOINT_OUT)

    @property
    def counts_per_nm(self) -> float:
        """Motor counts per N m at a leg, used to send forces."""
        return self._options.counts_per_nm or COUNTS_PER_NM


_active_blocks: Final[dict[int, Any]] = {}
"""Blocks that libusb may write to, by address: they outlive a device that is deleted without `close`."""


def identify(device: SystemDevice, options: Options) -> dict[str, bool]:
    """Return whether firmware runs in an attached Falcon; opens it to find out, and sends none.

    Raises DeviceNotFound, DevicePermission, DeviceBusy, DeviceLost or DeviceError.
    """
    chip = usb.open_chip(None, device.node)
    try:
        chip.set_run_mode()
        return {"firmware": firmware.has_firmware(chip)}
    finally:
        chip.close()


def open_device(options: Options, rate_hz: float) -> Falcon:
    """Open the Falcon that a rig describes, at any rate: sends the firmware if none runs, and waits for homing.

    Raises DeviceNotFound, DevicePermission, DeviceBusy, DeviceTimeout or DeviceError, each with the remedy.
    """
    return Falcon(options, firmware.start_firmware(partial(usb.open_chip, options.serial), options.firmware))
