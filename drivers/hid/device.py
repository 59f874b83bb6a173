"""HID device: memory of the exchange, calibration, and zero force on every shutdown path."""

from __future__ import annotations

import ctypes
import os
import time
from typing import Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import DeviceError, DeviceLost, DeviceTimeout
from softfinger.drivers.base import SAMPLE_SIZE, TIMEOUT, ZeroCommand
from softfinger.drivers.block import Block, BlockDevice
from softfinger.drivers.board_exchange import BOARD, BoardTimes, init_exchange
from softfinger.drivers.closeable import undo_on_error
from softfinger.drivers.described_board import DESCRIBED, init_described, make_described_info, set_model
from softfinger.drivers.fields import table
from softfinger.drivers.hid import exchange
from softfinger.drivers.hid.exchange import AT
from softfinger.drivers.hid.link import ReportLink, open_link
from softfinger.drivers.hid.options import Options, OutputReport
from softfinger.drivers.kinematics.mechanism import SINGULAR_POSE
from softfinger.drivers.kinematics.options import Chain
from softfinger.drivers.kinematics.subspace import rows as rows

STOP_WAIT_S: Final = 1.0
"""Maximum wait of a stop for a write in progress. A slower one hangs in the kernel."""
PRESET_WAIT_S: Final = 1.0
PRESET_TOLERANCE_COUNTS: Final = 20.0
"""Counts by which an arm held in its calibration pose may move before the answer arrives."""


class HidDevice(BlockDevice):
    """Open device, owner of the file descriptor `fd` (of its node or of `threads`) and of `threads`."""

    _functions = exchange.read, exchange.write

    def __init__(self, options: Options, link: ReportLink) -> None:
        self._options, self._link, self.threads = options, link, link.threads
        spec = options.reports
        self._zero = _encode_report(spec.output, {})
        self._block = self._make_block(link.fd)
        name = f"hid {spec.name or 'described'} {options.vendor_id:04x}:{options.product_id:04x}"
        self.info = make_described_info(self._block, options, options.kinematics, name)
        with undo_on_error(self.close):
            if options.calibrate:
                self._calibrate()
                self._block.word[BOARD.has_sample] = 0  # the sample from before the calibration has a wrong position

    def _make_block(self, fd: int) -> Block:
        block, options = Block(BOARD, DESCRIBED, AT), self._options
        # While waiting for a board, each wait sends a zero report.
        init_exchange(
            block, fd, BoardTimes(options.kick_s, options.kick_s, kick_awaiting=0.0, timeout=options.timeout_s)
        )
        word, spec = block.word, options.reports
        self._mechanism = init_described(block, options, options.kinematics, spec.input.field, spec.output.field)
        word[AT.in_id], word[AT.in_bytes] = spec.input.id, spec.input.bytes + (spec.input.id != 0)
        word[AT.out_bytes] = 1 + spec.output.bytes
        for buffer in (AT.in_buffer, AT.latest_report):
            block.set_address(buffer, np.zeros(word[AT.in_bytes] + exchange.IN_SPARE, np.uint8))
        out = np.zeros(word[AT.out_bytes], np.uint8)
        out[0] = spec.output.id
        block.set_address(AT.out_buffer, out)
        word[AT.accepted_address] = 0 if self.threads is None else self.threads.accepted_address
        return block

    def arm(self) -> None:
        """Wake the board and wait for a current report: minutes may have passed since the device was opened."""
        self._read_fresh_report()

    def stop(self) -> None:
        # Repeated calls wait only once for the full time for a write in progress.
        wait_s = STOP_WAIT_S - (0.0 if self.threads is None else self.threads.hang_duration_s())
        until = time.monotonic() + wait_s
        if self.threads is not None:
            self.threads.disarm(self._zero)
        is_zeroed = self._call_until_done(exchange.disarm_and_zero, wait_s)
        if is_zeroed and self.threads is not None:
            is_zeroed = self.threads.flush(self.counts()["written"], until)
        if not is_zeroed:
            self._report_zero_failure(self.reason() or f"writes have been pending for {STOP_WAIT_S:g} s")
        else:
            self._zero_failure = "its node accepts no report" if self._block.word[BOARD.has_force] else ""

    def close(self) -> None:
        self.stop()
        fd = int(self._block.word[BOARD.fd])
        self._block.word[BOARD.fd] = -1
        if fd >= 0:
            os.close(fd)
        if self.threads is not None:
            self.threads.close()

    def reason(self) -> str:
        if self.threads is None:
            return ""
        hang_s = self.threads.hang_duration_s()
        return f"a write has not returned for {hang_s:.2g} s" if hang_s else self.threads.failure

    def thread_ids(self) -> list[int]:
        return [] if self.threads is None else self.threads.native_ids

    def warning(self) -> str:
        return SINGULAR_POSE if self._block.word[DESCRIBED.singular] else ""

    def zero_command(self) -> ZeroCommand | None:
        link = self._link
        fd = int(self._block.word[BOARD.fd]) if self.threads is None else self.threads.lock_fd
        if link.endpoint:  # on the bus, the id 0 is not sent
            return ZeroCommand(link.node, None, self._zero[not self._zero[0] :], link.interface, link.endpoint)
        return ZeroCommand(link.node, fd, self._zero) if link.node and fd is not None else None

    def _calibrate(self) -> None:
        """Set the encoders to the calibration counts at the arm's present pose.

        With a preset report the device stores them beyond a restart of the program, otherwise they are added here.
        """
        kinematics = self._options.kinematics
        assert isinstance(kinematics, Chain)
        target_counts = np.array(kinematics.calibration_counts, dtype=np.float64)
        counts = self._read_counts()
        preset = self._options.reports.preset
        if preset is None:
            a, b, c = (float(v) for v in target_counts - counts)
            mechanism = self._mechanism._replace(chain=self._mechanism.chain._replace(offset=(a, b, c)))
            set_model(self._block, mechanism, self._options.mounting)
            return
        until = time.monotonic() + PRESET_WAIT_S
        self._send_preset(preset, target_counts)
        while np.max(np.abs(counts - target_counts)) > PRESET_TOLERANCE_COUNTS:
            if time.monotonic() > until:
                raise DeviceError(
                    f"{self.info.name} did not apply the calibration: encoders a, b, c are "
                    f"{counts.tolist()} and not {target_counts.tolist()}: hold the arm still in its calibration "
                    "pose, or set calibrate = false and press the calibration button"
                )
            try:
                counts = self._read_counts()
            except DeviceTimeout:  # a board may be silent while it stores its counts
                if time.monotonic() > until:
                    raise

    def _send_preset(self, report: OutputReport, counts: NDArray[np.float64]) -> None:
        data = _encode_report(report, {table.PRESET + k: float(counts[k]) for k in range(3)})
        try:
            os.write(int(self._block.word[BOARD.fd]), data)
        except OSError as error:
            raise DeviceLost(f"{self.info.name} was disconnected: {error.strerror}: plug it in again") from error
        self._block.word[AT.written] += 1
        if self.threads is not None and not self.threads.flush(
            self.counts()["written"], time.monotonic() + PRESET_WAIT_S
        ):
            because = f" ({self.reason()})" if self.reason() else ""
            raise DeviceTimeout(f"{self.info.name} accepts no report{because}: check its power, and its firmware")

    def _read_fresh_report(self) -> None:
        """Read a current report; raises DeviceTimeout or DeviceLost if there is none."""
        self._block.word[BOARD.has_sample] = 0  # the next read waits for a report instead of repeating one
        status = exchange.read.ctypes(self._block.handle, (ctypes.c_double * SAMPLE_SIZE)())
        if status == TIMEOUT:
            raise DeviceTimeout(f"{self.info.name} sends no report: check its power, and its firmware")
        if status < 0:
            raise DeviceLost(f"{self.info.name} cannot be read (status {status}): plug it in again")

    def _read_counts(self) -> NDArray[np.float64]:
        """Return the counts of encoders a, b, c in a current report, without the offset added to them."""
        self._read_fresh_report()
        return self._block.numbers(DESCRIBED.values + table.COUNTS, 3).copy()


def _encode_report(report: OutputReport, commanded: dict[int, float]) -> bytes:
    """Return a report with its id first; values that are not in `commanded` (by index) are 0."""
    return bytes([report.id]) + table.encode_constants(report.field, report.bytes, commanded).tobytes()


def open_device(options: Options, rate_hz: float) -> HidDevice:
    """Open the device that a rig describes, at any rate; raises DeviceError or a subclass if it cannot be used."""
    device = HidDevice(options, open_link(options))
    exchange.write.ctypes(device.io().handle, (ctypes.c_double * 6)())  # a killed program may have left a force
    return device
