"""HID device: memory of the exchange, calibration, and zero force on every shutdown path."""

from __future__ import annotations

import logging
import os
import time
from typing import Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import DeviceError, DeviceLost, DeviceTimeout
from softfinger.drivers.base import SAMPLE_SIZE, TIMEOUT, Device, DeviceIO, LastWord
from softfinger.drivers.block import Block
from softfinger.drivers.conversation import TALK, Times, begin, info_of
from softfinger.drivers.fields import table
from softfinger.drivers.hid import exchange
from softfinger.drivers.hid.exchange import AT, Model
from softfinger.drivers.hid.link import open_link
from softfinger.drivers.hid.options import Options, OutputReport
from softfinger.drivers.hid.pump import Pump
from softfinger.drivers.kinematics.freedom import freedom_rows
from softfinger.drivers.kinematics.mechanism import SINGULAR_POSE, kind_of, make_mechanism
from softfinger.drivers.kinematics.options import Chain
from softfinger.proxy.kernels.jit.pack import flatten

log: Final = logging.getLogger(__name__)

STOP_WAIT_S: Final = 1.0
"""Maximum wait of a stop for a write in progress. A slower one hangs in the kernel."""
PRESET_WAIT_S: Final = 1.0
PRESET_NEAR: Final = 20.0
"""Counts by which an arm held in its calibration pose may move before the answer arrives."""


class HidDevice(Device):
    """Open device, owner of the file descriptor `fd` (of its node or of `pump`) and of `pump`."""

    def __init__(self, options: Options, fd: int, pump: Pump | None = None, node: str = "") -> None:
        self._options, self.pump, self._node, self._zero_failure = options, pump, node, ""
        given = options.kinematics
        self._mechanism = make_mechanism(given, options.force_max_n)
        spec = options.reports
        self._zero = _encoded(spec.output, {})
        wrist = isinstance(given, Chain) and given.wrist_counts_per_turn is not None
        turns = wrist or any(field.meaning == "qw" for field in spec.input.field)
        self._block = self._make_block(fd, kind_of(given, turns), turns)
        name = f"hid {spec.name or 'described'} {options.vendor_id:04x}:{options.product_id:04x}"
        self.info = info_of(options, name, sensed_dof=6 if turns else given.dof, actuated_dof=given.dof)
        try:
            if options.calibrate:
                self._calibrate()
                self._block.word[TALK.sensed] = 0  # the sample from before the calibration has a wrong position
        except BaseException:
            self.close()
            raise

    def _make_block(self, fd: int, kind: int, turns: bool) -> Block:
        block, options = Block(TALK, AT), self._options
        # While waiting for a board, each wait sends a zero report.
        begin(block, fd, Times(options.kick_s, options.kick_s, kick_awaiting=0.0, timeout=options.timeout_s))
        word, spec = block.word, options.reports
        word[AT.kind], word[AT.turns] = kind, turns
        block.numbers(AT.place, 3)[:] = self._mechanism.delta.home
        word[AT.in_id], word[AT.in_bytes] = spec.input.id, spec.input.bytes + (spec.input.id != 0)
        word[AT.out_bytes] = 1 + spec.output.bytes
        word[AT.in_rows], word[AT.out_rows] = len(spec.input.field), len(spec.output.field)
        block.point(AT.in_table, table.input_table(spec.input.field))
        block.point(AT.out_table, table.output_table(spec.output.field))
        for buffer in (AT.in_buffer, AT.newest):
            block.point(buffer, np.zeros(word[AT.in_bytes] + exchange.IN_SPARE, np.uint8))
        out = np.zeros(word[AT.out_bytes], np.uint8)
        out[0] = spec.output.id
        block.point(AT.out_buffer, out)
        word[AT.taken] = 0 if self.pump is None else self.pump.taken_at
        self._set_model(block)
        return block

    def _set_model(self, block: Block) -> None:
        model = Model(self._mechanism, *self._options.mounting.frame())
        block.numbers(AT.model, exchange.MODEL_SIZE)[:] = flatten(model)

    def io(self) -> DeviceIO:
        return DeviceIO(exchange.read.address, exchange.write.address, self._block.handle)

    def arm(self) -> None:
        """Wake the board and wait for a current report: minutes may have passed since the device was opened."""
        self._fresh_report()

    def stop(self) -> None:
        # For repeated calls the full wait applies once to a write in progress.
        hung_s = 0.0 if self.pump is None else self.pump.hangs_s()
        until = time.monotonic() + STOP_WAIT_S - hung_s
        told, self._zero_failure = bool(self._zero_failure), ""
        if self.pump is not None:
            self.pump.disarm(self._zero)
        while not exchange.silence.ctypes(self._block.handle):
            if time.monotonic() > until:
                self._tell_no_zero(told)
                return
            time.sleep(0.0001)
        if self.pump is not None and not self.pump.flush(self.counts()["written"], until):
            self._tell_no_zero(told)
        elif self._block.word[TALK.loaded]:
            self._zero_failure = "its node takes no report"

    def _tell_no_zero(self, told: bool) -> None:
        """Log that no zero was sent, once: the loop, the daemon and `close` each stop the device."""
        self._zero_failure = self.reason() or f"writes have not gone out for {STOP_WAIT_S:g} s"
        if not told:
            log.error("%s: no zero has reached it: %s", self.info.name, self._zero_failure)

    def zero_failure(self) -> str:
        return self._zero_failure

    def close(self) -> None:
        self.stop()
        fd = int(self._block.word[TALK.fd])
        self._block.word[TALK.fd] = -1
        if fd >= 0:
            os.close(fd)
        if self.pump is not None:
            self.pump.close()

    def reason(self) -> str:
        if self.pump is None:
            return ""
        hung_s = self.pump.hangs_s()
        return f"a write has been under way for {hung_s:.2g} s" if hung_s else self.pump.failure

    def warning(self) -> str:
        return SINGULAR_POSE if self._block.word[AT.singular] else ""

    def last_word(self) -> LastWord | None:
        return LastWord(self._node, int(self._block.word[TALK.fd]), self._zero) if self._node else None

    def counts(self) -> dict[str, int]:
        return self._block.counts()

    def _calibrate(self) -> None:
        """Set the encoders to the calibration counts at the arm's present pose.

        With a preset report the device stores them beyond a restart of the program, otherwise they are added here.
        """
        given = self._options.kinematics
        assert isinstance(given, Chain)
        wanted = np.array(given.calibration_counts, dtype=np.float64)
        seen = self._read_counts()
        preset = self._options.reports.preset
        if preset is None:
            a, b, c = (float(v) for v in wanted - seen)
            self._mechanism = self._mechanism._replace(chain=self._mechanism.chain._replace(offset=(a, b, c)))
            self._set_model(self._block)
            return
        until = time.monotonic() + PRESET_WAIT_S
        self._send_preset(preset, wanted)
        while np.max(np.abs(seen - wanted)) > PRESET_NEAR:
            if time.monotonic() > until:
                raise DeviceError(
                    f"{self.info.name} did not take the calibration: encoders a, b, c show "
                    f"{seen.tolist()} and not {wanted.tolist()}: hold the arm still in its calibration "
                    "pose, or set calibrate = false and press the calibration button"
                )
            try:
                seen = self._read_counts()
            except DeviceTimeout:  # a board may be silent while it stores its counts
                if time.monotonic() > until:
                    raise

    def _send_preset(self, report: OutputReport, counts: NDArray[np.float64]) -> None:
        data = _encoded(report, {table.PRESET + k: float(counts[k]) for k in range(3)})
        try:
            os.write(int(self._block.word[TALK.fd]), data)
        except OSError as error:
            raise DeviceLost(f"{self.info.name} is gone: {error.strerror}: plug it in again") from error
        self._block.word[AT.written] += 1
        if self.pump is not None and not self.pump.flush(self.counts()["written"], time.monotonic() + PRESET_WAIT_S):
            because = f" ({self.reason()})" if self.reason() else ""
            raise DeviceTimeout(f"{self.info.name} takes no report{because}: check its power, and its firmware")

    def _fresh_report(self) -> None:
        """Read a current report; raises DeviceTimeout or DeviceLost if there is none."""
        self._block.word[TALK.sensed] = 0  # the next read waits for a report instead of repeating one
        sample = np.zeros(SAMPLE_SIZE)
        status = exchange.read.ctypes(
            self._block.handle, sample.ctypes.data_as(exchange.read.ctypes.argtypes[1])
        )  # fmt: skip
        if status == TIMEOUT:
            raise DeviceTimeout(f"{self.info.name} sends no report: check its power, and its firmware")
        if status < 0:
            raise DeviceLost(f"{self.info.name} cannot be read (status {status}): plug it in again")

    def _read_counts(self) -> NDArray[np.float64]:
        """Return the counts of encoders a, b, c in a current report, without the offset added to them."""
        self._fresh_report()
        return self._block.numbers(AT.values + table.COUNTS, 3).copy()


def _encoded(report: OutputReport, commanded: dict[int, float]) -> bytes:
    """Return a report with its id first; values that are not in `commanded` (by index) are 0."""
    values, out = np.zeros(table.COMMANDED_SIZE), np.zeros(1 + report.bytes, np.uint8)
    out[0], values[table.CONSTANT] = report.id, 1.0
    for place, value in commanded.items():
        values[place] = value
    table.encode_once(values, table.output_table(report.field), np.zeros(1, np.int64), out)
    return out.tobytes()


def rows(options: Options) -> list[tuple[str, str]]:
    """Return additional rows for `softfinger check`."""
    return freedom_rows(options.kinematics, options.mounting)


def open_device(options: Options, rate_hz: float) -> HidDevice:
    """Open the device that a rig describes, at any rate; raises DeviceError or a subclass if it cannot be used."""
    link = open_link(options)
    return HidDevice(options, link.fd, link.pump, link.node)
