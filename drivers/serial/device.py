"""Device on a serial port: woken when opened, and commanded zero force on every shutdown path."""

from __future__ import annotations

import contextlib
import ctypes
import os
import time
from typing import Final

import numpy as np

from softfinger.config.errors import DeviceError, DeviceLost, DeviceTimeout
from softfinger.drivers.base import LOST, SAMPLE_SIZE, TIMEOUT, ZeroCommand, make_info
from softfinger.drivers.block import Block, BlockDevice
from softfinger.drivers.board_exchange import BOARD, BoardTimes, init_exchange
from softfinger.drivers.closeable import undo_on_error
from softfinger.drivers.described_board import DESCRIBED, init_described, make_described_info, set_model
from softfinger.drivers.fields.table import encode_constants
from softfinger.drivers.kinematics.mechanism import NO_MECHANISM, SINGULAR_POSE
from softfinger.drivers.kinematics.subspace import rows as rows
from softfinger.drivers.serial import exchange, frames, packets
from softfinger.drivers.serial.block import AT, CHUNK, TEXT
from softfinger.drivers.serial.options import Frames, Options, OutputFrame
from softfinger.drivers.serial.port import check as check
from softfinger.drivers.serial.port import close_port, count_unsent, open_port

STOP_WAIT_S: Final = 1.0
"""Time for a port to send the zero of a stop."""
STOP_AGAIN_S: Final = 0.1
"""Time for a repeated stop after a stop whose zero the port did not send."""
WARN_NS: Final = 1_000_000_000
"""Duration of the warning about a blocked port; the daemon checks warnings twice a second."""
BLOCKED: Final = (
    "too many frames are queued in the port: the line is too slow, or the board no longer reads: "
    "zero is sent in place of the force"
)


class SerialDevice(BlockDevice):
    """Open device, owner of the file descriptor `fd` of its port.

    Raises DeviceTimeout if it does not wake up, DeviceError if it sends no valid frame, DeviceLost if it disconnects.
    """

    _functions = exchange.read, exchange.write

    def __init__(self, options: Options, fd: int, path: str) -> None:
        self._options, self._path = options, path
        kinematics, spec = options.kinematics, options.frames
        self._setup, self._zero = b"", frames.ZERO
        if spec is not None:
            resync = b"" if spec.resync is None else bytes([spec.resync.byte]) * spec.resync.count
            self._setup = b"" if spec.setup is None else resync + _encode_frame(spec.setup, spec)
            self._zero = (self._setup or resync) + _encode_frame(spec.output, spec)
        self._block = self._make_block(fd)
        ids = "" if options.vendor_id is None else f" {options.vendor_id:04x}:{options.product_id:04x}"
        name = f"serial{ids} at {path}"
        if kinematics is None:
            # the rotation about the handle's axis is not sensed
            self.info = make_info(options, name, sensed_dof=5, centre_m=options.mounting.position_m)
        else:
            self.info = make_described_info(self._block, options, kinematics, name)
        with contextlib.suppress(OSError):
            count_unsent(fd)
            self._block.word[AT.counts_unsent] = 1
        # A killed program may have left a force, and a truncated frame: waking sends zeros.
        self._block.word[BOARD.has_force] = self._block.word[AT.maybe_torn] = 1
        with undo_on_error(self.close):
            self._wake(self._setup)

    def _make_block(self, fd: int) -> Block:
        block, options = Block(BOARD, DESCRIBED, AT), self._options
        spans = BoardTimes(options.quiet_s, options.kick_s, kick_awaiting=options.kick_s, timeout=options.timeout_s)
        spec = options.frames
        size = frames.FRAME_BYTES if spec is None else spec.input.bytes
        init_exchange(block, fd, spans, misread_max=size)
        word = block.word
        word[AT.answer_bytes] = 0 if spec is not None and spec.mode == "stream" else size
        word[AT.bytes_at_send] = -size  # nothing has been sent yet
        word[AT.newline] = frames.NEWLINE
        word[AT.out_bytes] = word[AT.out_total] = word[AT.frame_units] = frames.FRAME_BYTES
        block.raw_bytes(AT.incoming, frames.LOOKBACK)[:] = frames.NEWLINE
        if spec is None:
            word[DESCRIBED.kind], word[DESCRIBED.has_orientation] = TEXT, 1
            set_model(block, NO_MECHANISM._replace(force_max=float(options.force_max_n)), options.mounting)
        else:
            self._init_frames(block, spec)
        filler = 0 if spec is None or spec.resync is None else spec.resync.byte
        block.set_address(AT.outgoing, np.full(word[AT.out_total], filler, np.uint8))
        return block

    def _init_frames(self, block: Block, spec: Frames) -> None:
        word, options, big_endian = block.word, self._options, spec.order == "big"
        assert options.kinematics is not None
        init_described(block, options, options.kinematics, spec.input.field, spec.output.field, big_endian)
        word[AT.by_length] = spec.mode == "answer" and not spec.input.is_searchable()
        block.set_address(AT.in_shape, packets.make_shape(spec.input, big_endian))
        block.set_address(AT.out_shape, packets.make_shape(spec.output, big_endian))
        block.set_address(AT.stream, np.zeros(2 * spec.input.bytes + CHUNK, np.uint8))
        word[AT.out_bytes] = word[AT.frame_units] = spec.output.bytes
        word[AT.out_total] = spec.output.bytes + (0 if spec.resync is None else spec.resync.count)

    def _wake(self, setup: bytes = b"") -> None:
        """Send the setup and wake the device until it sends a frame.

        A device that was just plugged in takes a while to start, and gets the setup again with each attempt.
        """
        sample = (ctypes.c_double * SAMPLE_SIZE)()
        self._send_setup(setup)
        until = time.monotonic() + self._options.wake_s
        while (status := exchange.read.ctypes(self._block.handle, sample)) < 0:
            if status == LOST:
                raise DeviceLost(f"{self.info.name} was disconnected: plug it in again")
            if time.monotonic() < until:
                self._send_setup(setup)
                continue
            if status == TIMEOUT:
                raise DeviceTimeout(
                    f"{self.info.name} sends no frame within {self._options.wake_s:g} s: check its power and its "
                    f"firmware, or increase wake_s{self._make_unanswered_hint()}"
                )
            spec = self._options.frames
            expected = "eight numbers in 64 bytes"
            if spec is not None:
                expected = f"{spec.input.bytes} bytes as the rig describes them"
            raise DeviceError(
                f"{self.info.name} sends no frame of {expected} ({self.reason()}): check the device and its firmware"
            )

    def _make_unanswered_hint(self) -> str:
        spec = self._options.frames
        if spec is None or spec.mode == "stream":
            return ""
        sent_hex = _encode_frame(spec.output, spec).hex(" ")
        return (
            f"; it has not answered {sent_hex}, the frame without force: compare markers and checksum with its firmware"
        )

    def _send_setup(self, data: bytes) -> None:
        """Send bytes outside of ticks; bytes that the port does not accept are lost."""
        if data:
            with contextlib.suppress(OSError):
                self._block.word[AT.queued_bytes] += os.write(int(self._block.word[BOARD.fd]), data)
                self._block.word[AT.writes] += 1

    def arm(self) -> None:
        """Wake the board again and wait for a current frame: minutes may have passed since the port was opened."""
        self._block.word[BOARD.has_sample] = 0
        self._wake()

    def stop(self) -> None:
        """Drop unsent bytes, then send a zero and wait until it is sent."""
        if self._block.word[BOARD.fd] < 0:
            return
        # Repeated calls wait only once for the full time for a port that sends nothing.
        self._report_zero_failure(self._stop(STOP_AGAIN_S if self._zero_failure else STOP_WAIT_S))

    def _stop(self, wait_s: float) -> str:
        """Return why no zero was sent in this time; empty if it was."""
        until = time.monotonic() + wait_s
        for step in (exchange.discard, exchange.disarm_and_zero):
            if not self._call_until_done(step, until - time.monotonic()):
                return f"the port has accepted no data for {wait_s:g} s"
        try:
            while unsent := count_unsent(int(self._block.word[BOARD.fd])):
                if time.monotonic() > until:
                    return f"{unsent} bytes have been pending for {wait_s:g} s"
                time.sleep(0.0005)
        except OSError as error:
            return f"the port was removed: {error.strerror}"
        return ""

    def close(self) -> None:
        self.stop()
        fd = int(self._block.word[BOARD.fd])
        self._block.word[BOARD.fd] = -1
        if fd >= 0:
            if self._setup:  # a board that has lost its setup ignores zeros and keeps its torques
                with contextlib.suppress(OSError):
                    os.write(fd, self._zero)
            close_port(fd)

    def reason(self) -> str:
        word = self._block.word
        if word[AT.blocked_since]:
            return BLOCKED
        if word[BOARD.misread_bytes] < word[BOARD.misread_max]:
            return ""
        spec = self._options.frames
        if spec is None:
            return f"its last bytes are {self._block.raw_bytes(AT.incoming, frames.LOOKBACK).tobytes()!r}"
        last = ctypes.string_at(int(word[AT.stream]), spec.input.bytes)
        return f"its last bytes are {last.hex(' ')}"

    def warning(self) -> str:
        blocked_at = self._block.word[AT.blocked_at]
        if blocked_at and time.monotonic_ns() - blocked_at < WARN_NS:
            return BLOCKED
        return SINGULAR_POSE if self._block.word[DESCRIBED.singular] else ""

    def zero_command(self) -> ZeroCommand:
        return ZeroCommand(self._path, int(self._block.word[BOARD.fd]), self._zero)


def _encode_frame(frame: OutputFrame, spec: Frames) -> bytes:
    """Return a frame of the constants, with zero for everything commanded."""
    is_big = spec.order == "big"
    data, shape = encode_constants(frame.field, frame.bytes, big_endian=is_big), packets.make_shape(frame, is_big)
    packets.complete_frame(data.ctypes.data, shape.ctypes.data)
    return data.tobytes()


def open_device(options: Options, rate_hz: float) -> SerialDevice:
    """Open the device that a rig describes, at any rate; raises DeviceError or a subclass if it cannot be used."""
    return SerialDevice(options, *open_port(options))
