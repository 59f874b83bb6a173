"""Board of the guide in docs/devices/serial.md, in Python and real time: one motor, frames with a mark and a crc8.

Written from the page. Not modelled: everything of a real board except these frames.
"""

import struct
import time

from emulators.farterminal import FarTerminal

SILENCE_S = 0.05


def crc8(data: bytes) -> int:
    crc = 0
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x107) if crc & 0x80 else crc << 1
    return crc


class GuideBoard(FarTerminal):
    """Board with a joint at `angle` (rad) and a motor with `torque` (N m); `most` is the maximum torque so far."""

    def __init__(self) -> None:
        super().__init__(period_s=0.001)
        self.angle, self.torque, self.most = 0.0, 0.0, 0.0
        self._rest, self._received_s = b"", time.monotonic()

    def turn(self) -> None:
        frame = b"\xa5" + struct.pack("<h", round(self.angle / 0.001))
        self.say(frame + bytes([crc8(frame)]))
        self._rest += self.read()
        while len(self._rest) >= 4:
            frame = self._rest[:4]
            if frame[0] == 0x5A and crc8(frame[:3]) == frame[3]:
                self.torque = struct.unpack("<h", frame[1:3])[0] * 1e-6
                self.most = max(self.most, self.torque)
                self._rest, self._received_s = self._rest[4:], time.monotonic()
            else:
                self._rest = self._rest[1:]
        if time.monotonic() - self._received_s > SILENCE_S:
            self.torque = 0.0
