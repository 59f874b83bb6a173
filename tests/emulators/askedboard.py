"""Board with a custom protocol: it answers requests, numbers are big-endian, and checksums differ by direction.

Pure Python in real time, independent of the driver.

    request   55 54  torque_a  torque_b  crc16 (Modbus, high byte first)    int16, 0.1 mN m
    answer    7E  buttons  angle_a  angle_b  crc16 (CCITT)                  int16, 0.01 degrees

Damaged requests are not answered. Not modelled: everything of a real board except these frames.
"""

from __future__ import annotations

import struct

from emulators.farterminal import FarTerminal


def modbus(data: bytes) -> int:
    crc = 0xFFFF
    for byte in data:
        for bit in range(8):
            odd = (crc ^ byte >> bit) & 1
            crc = crc >> 1 ^ 0xA001 * odd
    return crc


def ccitt(data: bytes) -> int:
    crc = 0xFFFF
    for byte in data:
        for bit in range(7, -1, -1):
            odd = crc >> 15 ^ byte >> bit & 1
            crc = (crc << 1 ^ 0x1021 * odd) & 0xFFFF
    return crc


class AskedBoard(FarTerminal):
    """Board with joint `angles` (rad) and motor `torques` (N m)."""

    def __init__(self) -> None:
        super().__init__(period_s=0.0002)
        self.angles, self.torques, self.buttons = (0.0, 0.0), (0.0, 0.0), 0
        self.refused: list[bytes] = []
        """Damaged requests."""
        self._rest = b""

    def answer(self, request: bytes) -> bytes:
        if request[:2] != b"\x55\x54" or struct.unpack(">H", request[6:])[0] != modbus(request[:6]):
            self.refused.append(request)
            return b""
        first, two = struct.unpack(">hh", request[2:6])
        self.torques = (first * 1e-4, two * 1e-4)
        shown = [round(angle / 1.7453292519943296e-4) for angle in self.angles]
        head = struct.pack(">BBhh", 0x7E, self.buttons, *shown)
        return head + struct.pack(">H", ccitt(head))

    def turn(self) -> None:
        self._rest += self.read()
        while len(self._rest) >= 8:
            reply, self._rest = self.answer(self._rest[:8]), self._rest[8:]
            self.say(reply)
