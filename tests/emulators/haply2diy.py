"""Haply 2DIY behind a pseudo terminal, in real time: its M0 board's firmware byte by byte, and its pantograph.

Written from the firmware's published source (Haply_M0_Firmware V0.3: one command every 50 us at most, reads of torques
that wait for missing bytes for a second, torques that last until the next, a reset that switches no motor off) and from
the maker's host program (HaplyHAPI 1.0.1: setup, order of ports, links), independent of the driver.

Not modelled: directions of motors and encoders of a real device, USB packets (a terminal splits frames elsewhere), the
time of the processor, encoder steps, and a board with another firmware.
"""

from __future__ import annotations

import os
import select
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from math import cos, hypot, radians, sin, sqrt

from emulators.farterminal import Terminal

LINKS = (0.038, 0.07, 0.09)
"""Between the motors, inner, outer; m."""
TORQUE_MAX = 0.123
READ_WAIT_S = 1.0
"""Time that Arduino's Stream waits for bytes."""
STEP_S = 50e-6
TREMOR = 3e-5
"""Tremor of a hand in degrees, two steps of a float32: less than 0.1 um at the handle."""


def place(a: float, b: float) -> tuple[float, float]:
    """Return the handle (m, from the axis of motor 1) for angles (degrees) of the inner links."""
    base, inner, outer = LINKS
    xa, ya = inner * cos(radians(a)), inner * sin(radians(a))
    xb, yb = base + inner * cos(radians(b)), inner * sin(radians(b))
    apart = hypot(xb - xa, yb - ya)
    up = sqrt(outer * outer - apart * apart / 4)
    return ((xa + xb) / 2 - up * (yb - ya) / apart, (ya + yb) / 2 + up * (xb - xa) / apart)


class Firmware:
    """The board's program. `angles` (degrees) of links 1 and 2; link 1 is on port 2, 2 on port 1."""

    def __init__(self) -> None:
        self.angles = [168.0, 12.0]
        self.torques = [0.0, 0.0]
        """Torques of the motors on ports 1 and 2 (N m)."""
        self.log: list[tuple[float, float, float]] = []
        """Time (s, monotonic clock) and torques of each change."""
        self.given: list[tuple[float, float, float]] = []
        """The same of every command."""
        self.host = [0, 0]
        """Device that the motors and encoders of each port belong to; 0: none."""
        self.encoders = [(0.0, 0.0)] * 2
        """Offset set for an encoder, and the angle of its link at that time (degrees)."""
        self.setups = self.answers = self.commands = 0

    def motor(self, port: int) -> int:
        return 1 - port  # of the link

    def give(self, torques: list[float]) -> None:
        most = max(TORQUE_MAX, *(abs(t) for t in torques if t == t))
        cut = [0.0 if t != t else t * TORQUE_MAX / most for t in torques]
        self.given.append((time.monotonic(), *cut))
        if cut != self.torques:
            self.torques = cut
            self.log.append(self.given[-1])

    def setup(self, port: Port) -> None:
        self.host = [0, 0]
        device = port.read()
        uses = []
        for _ in range(2):  # motors, then encoders
            use = port.read()
            on = [use & 1, use >> 1 & 1]
            uses.append((on, [port.read() for _ in range(sum(on))]))
        for _ in range(2):  # analog sensors, then PWM pins
            for _ in range(max(port.read(), 0)):
                port.read()
        for k in range(2):
            if uses[1][0][k]:
                offset, _counts = struct.unpack("<ff", port.read_bytes(8).ljust(8, b"\0"))
                self.encoders[k] = (offset, self.angles[self.motor(k)])
                self.host[k] = device
        self.setups += 1

    def write_states(self, port: Port) -> bytes:
        device = port.read()
        mine = [k for k in range(2) if self.host[k] == device]
        data = port.read_bytes(4 * len(mine)).ljust(4 * len(mine), b"\0")
        torques = list(self.torques)
        for k, value in zip(mine, struct.unpack(f"<{len(mine)}f", data), strict=True):
            torques[k] = value
        if mine:
            self.give(torques)
            self.commands += 1
        tremor = TREMOR if self.answers % 2 else 0.0
        shown = [self.encoders[k][0] + self.angles[self.motor(k)] - self.encoders[k][1] + tremor for k in mine]
        return bytes([device & 0xFF]) + struct.pack(f"<{len(mine)}f", *shown)

    def loop(self, port: Port) -> None:
        if not port.available():
            return
        command = port.read()
        if command == 0:
            port.read()
            self.host = [0, 0]  # the motors retain their torque
        elif command == 1:
            self.setup(port)
        elif command == 2:
            answer = self.write_states(port)
            self.answers += 1
            port.write(answer)


class Port(Terminal):
    def __init__(self, board: Firmware) -> None:
        super().__init__()
        self.board = board
        self.hears: Callable[[bytes], bytes] = bytes
        """Change of the bytes to the board on the line."""
        self.spoil: Callable[[bytes], bytes] = bytes
        """Change of an answer on the line."""
        self._came = bytearray()
        self._thread.start()

    def _run(self) -> None:
        while not self._pulled.is_set():
            self.board.loop(self)
            self._fill(0.002)
            time.sleep(STEP_S)

    def _fill(self, wait_s: float) -> None:
        if not self._came and select.select([self._far], [], [], wait_s)[0]:
            with suppress(OSError):
                self._came += self.hears(os.read(self._far, 4096))

    def available(self) -> int:
        self._fill(0.0)
        return len(self._came)

    def read(self) -> int:
        """Return the next byte, or -1 if there is none, without waiting: as Arduino's."""
        self._fill(0.0005)  # USB delivers a packet at once
        return self._came.pop(0) if self._came else -1

    def read_bytes(self, count: int) -> bytes:
        out, until = b"", time.monotonic() + READ_WAIT_S
        while len(out) < count and time.monotonic() < until and not self._pulled.is_set():
            self._fill(0.002)
            if self._came:
                out += bytes([self._came.pop(0)])
        return out

    def write(self, data: bytes) -> None:
        if not self.mute.is_set():
            self.say(self.spoil(data))

    def power_off(self) -> None:
        self.board.give([0.0, 0.0])
