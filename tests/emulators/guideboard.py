"""The board of the guide in docs/devices/serial.md, in Python and real time: one motor, frames with a mark and a crc8.

Written from the page. What it would miss: everything of a real board but these frames.
"""

from __future__ import annotations

import os
import struct
import threading
import time
import tty
from contextlib import suppress
from typing import Self

SILENCE_S = 0.05


def crc8(data: bytes) -> int:
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x107) if crc & 0x80 else crc << 1
    return crc


class GuideBoard:
    """A thread at the far end of a pseudo terminal. `angle` (rad) is the joint's, `torque` (N m) the motor's."""

    def __init__(self) -> None:
        self.angle, self.torque, self.most = 0.0, 0.0, 0.0
        self._far, self._near = os.openpty()
        tty.setraw(self._near)
        os.set_blocking(self._far, False)
        self.path = os.ttyname(self._near)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        rest, heard = b"", time.monotonic()
        while not self._over.wait(0.001):
            frame = b"\xa5" + struct.pack("<h", round(self.angle / 0.001))
            with suppress(BlockingIOError):
                os.write(self._far, frame + bytes([crc8(frame)]))
            with suppress(BlockingIOError):
                rest += os.read(self._far, 4096)
            while len(rest) >= 4:
                if rest[0] == 0x5A and crc8(rest[:3]) == rest[3]:
                    self.torque = struct.unpack("<h", rest[1:3])[0] * 1e-6
                    self.most = max(self.most, self.torque)
                    rest, heard = rest[4:], time.monotonic()
                else:
                    rest = rest[1:]
            if time.monotonic() - heard > SILENCE_S:
                self.torque = 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()
        os.close(self._near)
        os.close(self._far)
