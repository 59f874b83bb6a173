"""WoodenHaptics' third generation with a hand on it, behind a pseudo terminal. Pure Python.

Written from the published format of the frames, independent of the driver. The board answers each frame and each
newline with one frame, and retains a force until the next. Each frame of the host moves the handle by one millisecond,
so that a slow connection changes no physics.
"""

import fcntl
import os
import select
import termios
import threading
import time
from array import array
from collections.abc import Callable
from math import atan2, hypot

from emulators.farterminal import Terminal
from emulators.hand import Handle, Vector

FRAME_BYTES = 64
FOOT_M = 0.2
"""Distance of the arm's vertical axis behind the middle of its workspace."""


class Board(Handle):
    """The handle behind its board.

    early_end  True if a newline also follows the last number, not only the frame
    """

    def __init__(self, intention: Callable[[float], Vector], early_end: bool = False) -> None:
        super().__init__(intention)
        self.early_end = early_end
        self.wrist = (0.1, -0.2)
        """Angles D and E (rad)."""
        self.info = 0
        self.force: Vector = (0.0, 0.0, 0.0)
        """Force of the motors now (N)."""
        self.wakes = 0
        self.sent: list[tuple[int, ...]] = []
        """Numbers of every frame of the host."""
        self.sent_at: list[float] = []
        """Times (s) of these frames."""
        self.faults: list[bytes] = []
        """Lines that were neither a frame nor a single newline."""

    def angles(self) -> tuple[float, float, float, float]:
        """Return tA, lambda, tD, tE (rad): the arm points to its handle, and dips toward it."""
        x, y, z = self.place
        return (atan2(y, x + FOOT_M), atan2(z, hypot(x + FOOT_M, y)), *self.wrist)

    def answer(self, line: bytes) -> bytes:
        words = line.split()
        if line == b"\n":
            self.wakes += 1
        elif len(line) != FRAME_BYTES or len(words) != 7 or words[3:] != [b"2", b"0", b"0", b"0"]:
            self.faults.append(line)
        else:
            numbers = tuple(int(word) for word in words)
            self.sent_at.append(time.monotonic())
            self.sent.append(numbers)
            self.force = (numbers[0] / 1e3, numbers[1] / 1e3, numbers[2] / 1e3)
            self.move(self.force)
        return self.frame()

    def frame(self) -> bytes:
        x, y, z = (1e3 * p for p in self.place)
        a, b, d, e = self.angles()
        text = f"{x: 8.3f} {y: 8.3f} {z: 8.3f} {a: 7.4f} {b: 7.4f} {d: 7.4f} {e: 7.4f} {self.info}"
        return (text + "\n" * self.early_end).ljust(FRAME_BYTES - 1).encode() + b"\n"


class Cable(Terminal):
    def __init__(self, board: Board) -> None:
        super().__init__()
        self.board = board
        self._deaf, self._reading, self._saying = False, threading.Lock(), threading.Lock()
        self.rest = b""
        """Bytes of an incomplete line."""
        self.spoil: Callable[[bytes], bytes] = bytes
        """Change of an answer on the line."""
        self.came = 0
        """Bytes read from the line."""
        self.received_bytes = 0
        """Bytes processed and answered."""
        self.idle_before: list[float] = []
        """Latest time (s) before each frame of the host at which there were no bytes to read."""
        self._thread.start()

    def _run(self) -> None:
        poll, idle_at = select.poll(), time.monotonic()
        poll.register(self._far, select.POLLIN)
        while not self._pulled.is_set():
            now = time.monotonic()
            if not poll.poll(0):
                idle_at = now
            if self._deaf or not poll.poll(5):
                time.sleep(0.0002)
                continue
            with self._reading:
                if not self._deaf:
                    data = os.read(self._far, 4096)
                    self.came += len(data)
                    self.rest += data
            while (end := self.rest.find(b"\n") + 1) > 0:
                line, self.rest = self.rest[:end], self.rest[end:]
                if len(line) == FRAME_BYTES:
                    self.idle_before.append(idle_at)
                answer = self.board.answer(line)
                with self._saying:
                    if not self.mute.is_set():
                        self.say(self.spoil(answer))
                self.received_bytes += len(line)

    def sent_to(self) -> int:
        waiting = array("i", [0])
        fcntl.ioctl(self._far, termios.FIONREAD, waiting)
        return waiting[0] + self.came

    def hear(self, now: bool) -> None:
        with self._reading:
            self._deaf = not now

    def hush(self) -> None:
        with self._saying:
            self.mute.set()
