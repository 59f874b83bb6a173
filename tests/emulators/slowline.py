"""Real-time serial line between a driver and an emulated board: baud / 10 bytes per second each way.

Written from tty_ioctl(4) and termios(3), independent of the driver. The driver's port is a pseudo terminal in packet
mode, so that its far end sees a flush (TIOCPKT_FLUSHWRITE). A thread moves written bytes into a queue, as a UART driver
does, and from there to the board. `stubs/uart.c` reports the length of that queue to the program under test. Not
modelled: the hardware buffers of UARTs and USB chips.
"""

import fcntl
import mmap
import os
import select
import struct
import termios
import threading
import time
import tty
from collections import deque
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any

BITS = 10
"""Bits per byte: start, eight of data, stop."""
QUEUE_BYTES = 4096
"""Capacity of a UART driver's queue (UART_XMIT_SIZE)."""
STEP_S = 0.0005
_WORDS = struct.Struct("5q")
_WRITTEN, _GONE, _FLUSHED, _HEEDED, _TERMINAL = range(5)


class SlowLine(AbstractContextManager[Any]):
    def __init__(self, board: str, baud: int, folder: Path) -> None:
        self._far, near = os.openpty()
        tty.setraw(near)
        self._near = near
        fcntl.ioctl(self._far, termios.TIOCPKT, struct.pack("i", 1))
        os.set_blocking(self._far, False)
        self.path = os.ttyname(near)
        self._board = os.open(board, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        tty.setraw(self._board)
        self.shared = folder / "line"
        self.shared.write_bytes(bytes(_WORDS.size))
        with self.shared.open("r+b") as file:
            self._words = memoryview(mmap.mmap(file.fileno(), _WORDS.size)).cast("q")
        self._words[_TERMINAL] = os.fstat(near).st_rdev
        self._rate = baud / BITS
        self._queue: deque[int] = deque()
        """Bytes for the board."""
        self.stalled = threading.Event()
        """If set, the line transmits nothing to the board, like a USB board that does not read."""
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        return len(self._queue)

    def queued(self) -> bytes:
        return bytes(self._queue.copy())

    def environment(self, stub: Path) -> dict[str, str]:
        return {**os.environ, "LD_PRELOAD": str(stub), "SLOW_LINE": str(self.shared)}

    def _run(self) -> None:
        before, credit, credit_back = time.monotonic(), 0.0, 0.0
        while not self._over.is_set():
            select.select([self._far, self._board], [], [], STEP_S)
            now = time.monotonic()
            credit, credit_back = (c + self._rate * (now - before) for c in (credit, credit_back))
            before = now
            try:
                self._take()
                credit -= self._carry(int(credit))
                credit_back -= self._carry_back(int(credit_back))
            except OSError:  # one end was closed
                return
            credit, credit_back = min(credit, 1.0 + credit % 1.0), min(credit_back, 1.0 + credit_back % 1.0)

    def _take(self) -> None:
        while len(self._queue) < QUEUE_BYTES:
            try:
                packet = os.read(self._far, 1 + QUEUE_BYTES - len(self._queue))
            except BlockingIOError:
                break
            if packet[0] & termios.TIOCPKT_FLUSHWRITE:  # older bytes may still be unread; the writer waits
                with suppress(BlockingIOError):
                    while os.read(self._far, QUEUE_BYTES):
                        pass
                self._queue.clear()
                self._words[_GONE] = self._words[_WRITTEN]
                self._words[_HEEDED] = self._words[_FLUSHED]
            elif packet[0] == termios.TIOCPKT_DATA:
                self._queue.extend(packet[1:])

    def _carry(self, most: int) -> int:
        count = 0 if self.stalled.is_set() else min(most, len(self._queue))
        if count > 0:
            os.write(self._board, bytes(self._queue.popleft() for _ in range(count)))
            self._words[_GONE] += count
        return count

    def _carry_back(self, most: int) -> int:
        if most <= 0:
            return 0
        try:
            data = os.read(self._board, most)
        except BlockingIOError:
            return 0
        with suppress(BlockingIOError):  # the host does not read
            os.write(self._far, data)
        return len(data)

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        for fd in (self._board, self._near, self._far):
            os.close(fd)
