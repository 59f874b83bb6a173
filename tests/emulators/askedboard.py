"""A board of somebody's own with a protocol of its own: it answers requests, numbers have their high byte first, and
both directions have a checksum of two bytes, each of another kind. Python alone, in real time; nothing comes from the
driver.

    request   55 54  torque_a  torque_b  crc16 (Modbus, high byte first)    int16, 0.1 mN m
    answer    7E  buttons  angle_a  angle_b  crc16 (CCITT)                  int16, 0.01 degrees

A request that is damaged is not answered. What it would miss: everything of a real board but these frames.
"""

from __future__ import annotations

import struct

from emulators.farterminal import FarTerminal


def modbus(data: bytes) -> int:
    """Bit by bit, from the least: 0x8005 reflected."""
    crc = 0xFFFF
    for byte in data:
        for bit in range(8):
            odd = (crc ^ byte >> bit) & 1
            crc = crc >> 1 ^ 0xA001 * odd
    return crc


def ccitt(data: bytes) -> int:
    """Bit by bit, from the greatest: 0x1021."""
    crc = 0xFFFF
    for byte in data:
        for bit in range(7, -1, -1):
            odd = crc >> 15 ^ byte >> bit & 1
            crc = (crc << 1 ^ 0x1021 * odd) & 0xFFFF
    return crc


class AskedBoard(FarTerminal):
    """`angles` (rad) are the joints', `torques` (N m) the motors'."""

    def __init__(self) -> None:
        super().__init__(period_s=0.0002)
        self.angles, self.torques, self.buttons = (0.0, 0.0), (0.0, 0.0), 0
        self.refused: list[bytes] = []
        """Requests that were damaged."""
        self._rest = b""

    def answer(self, request: bytes) -> bytes:
        """The answer to eight bytes; none to what is no request."""
        if request[:2] != b"\x55\x54" or struct.unpack(">H", request[6:])[0] != modbus(request[:6]):
            self.refused.append(request)
            return b""
        one, two = struct.unpack(">hh", request[2:6])
        self.torques = (one * 1e-4, two * 1e-4)
        shown = [round(angle / 1.7453292519943296e-4) for angle in self.angles]
        head = struct.pack(">BBhh", 0x7E, self.buttons, *shown)
        return head + struct.pack(">H", ccitt(head))

    def turn(self) -> None:
        self._rest += self.read()
        while len(self._rest) >= 8:
            reply, self._rest = self.answer(self._rest[:8]), self._rest[8:]
            self.write(reply)
