"""Transfer of reports between hidapi and a socket that replaces a node, by two threads.

hidapi is called from Python, so the loop cannot use it. A packet socket preserves the boundaries of reports like a
hidraw node, and its end is a file descriptor: the exchange reads and writes it like a node, and never waits for the
bus. A device that fails closes the socket, which the exchange detects like a disconnected node.
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
"""Buffer size of the socket in each direction, as counted by the system: 64 short reports, like a node's queue."""
REPORT_MAX: Final = 1025
"""Maximum bytes of a report, with its id."""
READ_MS: Final = 20
"""Timeout of a read; closing may take as long."""
CLOSE_WAIT_S: Final = 0.5
"""Maximum wait of `close` for the threads. A slower one hangs in hidapi."""
FLUSH_POLL_S: Final = 1e-4


class HidApi(Protocol):
    """Used part of hidapi's device, for both backends. Both calls release the interpreter lock."""

    def read(self, max_length: int, timeout_ms: int = ...) -> list[int]:
        """Return the next report, empty after a timeout. Raises OSError if the device is disconnected."""

    def write(self, buff: bytes) -> int:
        """Send a report, its id first; return the number of bytes, -1 if the device is disconnected or accepts none."""

    def close(self) -> None: ...


class ReportThreads:
    """Threads between a device and their end of the socket.

    device           open; owned by this object, and closed by the thread that ends last
    read_bytes       size of one read
    write_timeout_s  a write that takes longer hangs: the exchange gives the device up
    lock_fd          file descriptor, locked against other programs, to close with the device; None: none

    `fd` is the driver's end; the caller owns it.
    """

    def __init__(self, device: HidApi, read_bytes: int, write_timeout_s: float, lock_fd: int | None = None) -> None:
        self._device, self._bytes, self._write_timeout_s = device, read_bytes, write_timeout_s
        self.lock_fd: Final = lock_fd
        driver_end, self._threads_end = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        for end in (driver_end, self._threads_end):
            end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, QUEUE_BYTES)
        driver_end.setblocking(False)
        self.fd: Final = driver_end.detach()
        self.failure = ""
        """Error that ended a thread before `close`; empty without one."""
        self._accepted = np.zeros(2, dtype=np.int64)
        self._zero: bytes | None = None
        self._write_start: float | None = None  # s, monotonic clock: start of the write in progress
        self._ending = threading.Event()
        # A device that cannot be read may still accept a zero: the writer continues until the driver's end is closed.
        self._reader = threading.Thread(
            target=self._run, args=(self._read, socket.SHUT_WR), name="hid reader", daemon=True
        )
        self._writer = threading.Thread(
            target=self._run, args=(self._write, socket.SHUT_RDWR), name="hid writer", daemon=True
        )
        self._count_lock = threading.Lock()
        self._running_count = 2
        threads = [self._reader, self._writer]
        try:
            while threads:
                threads[0].start()
                del threads[0]
        except RuntimeError:  # the system has no thread left
            os.close(self.fd)
            self._ending.set()
            for _ in threads:
                self._finish()
            raise

    @property
    def native_ids(self) -> list[int]:
        return [thread.native_id for thread in (self._reader, self._writer) if thread.native_id is not None]

    @property
    def accepted(self) -> int:
        """Number of the driver's reports that the device has accepted."""
        return int(self._accepted[0])

    @property
    def accepted_address(self) -> int:
        """Address of two int64, valid as long as this object: `accepted`, and 1 while a write hangs."""
        return int(self._accepted.ctypes.data)

    def hang_duration_s(self) -> float:
        """Return the duration (s) of the write in progress; 0 up to `write_timeout_s`."""
        start = self._write_start
        duration = 0.0 if start is None else time.monotonic() - start
        return duration if duration > self._write_timeout_s else 0.0

    def disarm(self, zero: bytes) -> None:
        """Replace every report of the driver by `zero` from now on, including queued ones."""
        self._zero = zero

    def flush(self, count: int, until: float) -> bool:
        """Wait until the device has accepted the first `count` reports of the driver.

        until    s, monotonic clock
        returns  False if it has not accepted them by then, or the writer has ended
        """
        while self.accepted < count and self._writer.is_alive() and time.monotonic() < until:
            time.sleep(FLUSH_POLL_S)
        return self.accepted >= count

    def close(self) -> None:
        """End the threads, which closes the device. May be called repeatedly; close the driver's end before."""
        self._ending.set()
        until = time.monotonic() + CLOSE_WAIT_S
        for thread in (self._reader, self._writer):
            thread.join(max(0.0, until - time.monotonic()))
            if thread.is_alive():
                log.error("%s: a call of hidapi does not return; the device will be closed when it does", thread.name)

    def _run(self, work: Callable[[], None], direction: int) -> None:
        try:
            work()
        except OSError as error:
            self.failure = self.failure or f"{threading.current_thread().name}: {error}"
        finally:
            with suppress(OSError):  # the driver's end is closed already
                self._threads_end.shutdown(direction)
            self._finish()

    def _finish(self) -> None:
        """Decrement the number of threads; close the device if none is left."""
        with self._count_lock:
            self._running_count -= 1
            last = self._running_count == 0
        if last:  # no call of hidapi is in progress any more
            self._device.close()
            self._threads_end.close()
            if self.lock_fd is not None:
                os.close(self.lock_fd)

    def _read(self) -> None:
        hung_write: float | None = None
        while not self._ending.is_set():
            report = bytes(self._device.read(self._bytes, READ_MS))
            start = self._write_start if self.hang_duration_s() else None
            # Twice in a row: after a pause of the process the writer may not have noticed yet that its write is over.
            self._accepted[1] = start is not None and start == hung_write
            hung_write = start
            if report and start is None:
                # Full: the driver has not read for long, and the new report is lost, as in the system's queue. Broken:
                # the driver has closed its end.
                with suppress(BlockingIOError, BrokenPipeError, ConnectionResetError):
                    self._threads_end.send(report, socket.MSG_DONTWAIT)

    def _write(self) -> None:
        try:
            # In order and without skipping any: the driver limits the number of queued reports.
            while report := self._receive():
                report = self._zero or report
                self._write_start = time.monotonic()
                count = self._device.write(report)
                hang_s, self._write_start = self.hang_duration_s(), None
                if count != len(report):
                    after = f" after {hang_s:.2g} s" if hang_s else ""
                    raise OSError(f"a write of {len(report)} bytes returned {count}{after}")
                self._accepted[0] += 1
        finally:
            self._ending.set()

    def _receive(self) -> bytes:
        """Return the next report of the driver; empty after its end is closed."""
        while True:
            try:
                return self._threads_end.recv(REPORT_MAX)
            except ConnectionResetError:
                pass  # raised once if the driver closed its end before reading all; queued reports can still be read
