"""Reports carried between hidapi and a socket that stands in for a node, by two threads.

hidapi's calls are Python's, so the loop cannot make them. A packet socket keeps the borders of reports as a hidraw node
does, and its end is a file descriptor: the exchange reads and writes it as it would the node, and never waits for the
bus. A device that fails closes the socket, which the exchange sees as a node that is gone.
"""

from __future__ import annotations

import logging
import os
import socket
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Final, Protocol

import numpy as np

log: Final = logging.getLogger(__name__)

QUEUE_BYTES: Final = 24576
"""Room of the socket each way, as the system counts it: 64 short reports, as many as it keeps for a node."""
REPORT_MAX: Final = 1025
"""Bytes of the longest report, with its id."""
READ_MS: Final = 20
"""Time of one wait for a report; closing may take as long."""
CLOSE_WAIT_S: Final = 0.5
"""How long closing waits for the threads. One that takes longer hangs in hidapi."""
FLUSH_POLL_S: Final = 1e-4


class HidApi(Protocol):
    """What is used of hidapi's device, whichever its backend. Both calls release the interpreter lock."""

    def read(self, max_length: int, timeout_ms: int = ...) -> list[int]:
        """The next report, empty when none came in time. OSError when the device is gone."""

    def write(self, buff: bytes) -> int:
        """Send a report with its id in front; how many bytes went, -1 when the device is gone or took none."""

    def close(self) -> None: ...


class Pump:
    """The threads, and their end of the socket.

    device      open, and the pump's from now on: the thread that ends last closes it
    read_bytes  what is asked for in one read
    patience_s  a device that takes no report for so long counts as silent: none of its own are passed on
    held        a file descriptor that is closed with the device, whose lock keeps others out; None: there is none

    `fd` is the driver's end, which belongs to whoever made the pump.
    """

    def __init__(self, device: HidApi, read_bytes: int, patience_s: float, held: int | None = None) -> None:
        self._device, self._bytes, self._patience_s, self._held = device, read_bytes, patience_s, held
        ours, self._end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for end in (ours, self._end):
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, QUEUE_BYTES)
        ours.setblocking(False)
        self.fd: Final = ours.detach()
        self.failure = ""
        """What ended the pump before it was closed; empty while nothing did."""
        self._taken = np.zeros(1, dtype=np.int64)
        self._zero: bytes | None = None
        self._began: float | None = None  # s, monotonic clock: of the write under way
        self._ending = threading.Event()
        # A device that cannot be read may still take a zero: the writer goes on until the driver's end is closed.
        self._reader = threading.Thread(
            target=self._run, args=(self._read, socket.SHUT_WR), name="hid reader", daemon=True
        )
        self._writer = threading.Thread(
            target=self._run, args=(self._write, socket.SHUT_RDWR), name="hid writer", daemon=True
        )
        self._leaving = threading.Lock()
        self._running = 2
        self._reader.start()
        self._writer.start()

    @property
    def taken(self) -> int:
        """Reports of the driver that the device has taken."""
        return int(self._taken[0])

    @property
    def taken_at(self) -> int:
        """Address of `taken`, an int64, valid as long as the pump is there."""
        return int(self._taken.ctypes.data)

    def hangs_s(self) -> float:
        """For how long (s) a write has been under way; 0 while that is within the patience."""
        began = self._began
        lasted = 0.0 if began is None else time.monotonic() - began
        return lasted if lasted > self._patience_s else 0.0

    def disarm(self, zero: bytes) -> None:
        """From now on send `zero` in the place of whatever the driver has sent, also of what waits in the socket."""
        self._zero = zero

    def flush(self, sent: int, until: float) -> bool:
        """Wait until the device has taken the first `sent` reports of the driver.

        until    s, monotonic clock
        returns  False if it has not by then, or never will
        """
        while self.taken < sent and self._writer.is_alive() and time.monotonic() < until:
            time.sleep(FLUSH_POLL_S)
        return self.taken >= sent

    def close(self) -> None:
        """End the threads and with them the device. Any number of times; the driver's end is to be closed before."""
        self._ending.set()
        until = time.monotonic() + CLOSE_WAIT_S
        for thread in (self._reader, self._writer):
            thread.join(max(0.0, until - time.monotonic()))
            if thread.is_alive():
                log.error("%s: a call of hidapi hangs; the device is closed once it returns", thread.name)

    def _run(self, work: Callable[[], None], ended: int) -> None:
        try:
            work()
        except OSError as error:
            self.failure = self.failure or f"{threading.current_thread().name}: {error}"
        finally:
            with suppress(OSError):  # the driver's end is closed already
                self._end.shutdown(ended)
            with self._leaving:
                self._running -= 1
                last = self._running == 0
            if last:  # no call of hidapi is under way any more
                self._device.close()
                self._end.close()
                if self._held is not None:
                    os.close(self._held)

    def _read(self) -> None:
        while not self._ending.is_set():
            report = bytes(self._device.read(self._bytes, READ_MS))
            if report and not self.hangs_s():
                # Full: nobody has read for long, and the newest is lost, as in the system's queue. Broken: the driver
                # has closed its end.
                with suppress(BlockingIOError, BrokenPipeError, ConnectionResetError):
                    self._end.send(report, socket.MSG_DONTWAIT)

    def _write(self) -> None:
        try:
            # In their order, and none passed over: the driver sends no more than may wait.
            while report := self._receive():
                report = self._zero or report
                self._began = time.monotonic()
                count = self._device.write(report)
                hung_s, self._began = self.hangs_s(), None
                if count != len(report):
                    after = f" after {hung_s:.2g} s" if hung_s else ""
                    raise OSError(f"a write of {len(report)} bytes came back as {count}{after}")
                self._taken[0] += 1
        finally:
            self._ending.set()

    def _receive(self) -> bytes:
        """The next report of the driver; empty once its end is closed."""
        while True:
            try:
                return self._end.recv(REPORT_MAX)
            except ConnectionResetError:
                pass  # said once, of a driver's end closed over unread reports: what it had sent is still there
