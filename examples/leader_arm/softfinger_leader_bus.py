"""Packets of bus servos on a serial line: Feetech STS/SMS (protocol 0) and Dynamixel X (protocol 2.0).

The makers' Python libraries are not used: their receive loop polls the port without a pause, so its thread blocks the
interpreter lock for the other threads of the daemon, and the published one for Feetech has far too long timeouts for
answers. The packets are short, and the waits here release the lock.
"""

from __future__ import annotations

import os
import select
import struct
import termios
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Final, NamedTuple

WRITE: Final = 0x03
SYNC_READ: Final = 0x82
BROADCAST: Final = 254
CHUNK: Final = 4096


class BusError(Exception):
    """A servo did not answer, or reported an error."""


class Register(NamedTuple):
    address: int
    size: int


class Answer(NamedTuple):
    """Status packet, and the number of bytes up to its end."""

    servo: int
    error: int
    data: bytes
    end: int


class Bus(ABC):
    """Servos on an open, raw serial line. Class attributes are registers and values of the series."""

    enable: Register
    mode: Register
    force: Register
    position: Register
    watchdog: Register | None = None
    """Register that stops the motor without requests, in units of 20 ms."""
    force_mode: int
    """Value of `mode` in which the motor follows `force`."""
    force_max: int
    """Largest number of counts in `force`."""

    def __init__(self, fd: int, wait_s: float) -> None:
        self._fd, self.wait_s = fd, wait_s

    def read(self, register: Register, servos: Sequence[int]) -> list[int]:
        """Return a register of several servos, in one transaction. Raises BusError, or OSError if the port is gone."""
        parameters = self._numbers(register.address, register.size) + bytes(servos)
        answers = self._transact(BROADCAST, SYNC_READ, parameters, servos, register.size)
        return [self.decode(answers[servo]) for servo in servos]

    def write(self, register: Register, servo: int, value: int) -> None:
        """Write a register and wait until the servo confirms it. Raises as `read`."""
        data = value.to_bytes(register.size, "little", signed=value < 0)
        self._transact(servo, WRITE, self._numbers(register.address) + data, [servo], 0)

    def _transact(
        self, servo: int, instruction: int, parameters: bytes, expected: Sequence[int], size: int
    ) -> dict[int, bytes]:
        """Send a request; return the data of each expected answer. One of another size answers an earlier request."""
        termios.tcflush(self._fd, termios.TCIFLUSH)  # late answers to an earlier request
        os.write(self._fd, self.packet(servo, instruction, parameters))
        received, answers, until = b"", dict[int, bytes](), time.monotonic() + self.wait_s
        while len(answers) < len(expected):
            left = until - time.monotonic()
            if left <= 0.0 or not select.select([self._fd], [], [], left)[0]:
                missing = ", ".join(str(each) for each in expected if each not in answers)
                raise BusError(f"servo {missing} has not answered within {self.wait_s:g} s")
            if not (data := os.read(self._fd, CHUNK)):
                raise OSError("the port is gone")
            received += data
            while (answer := self.parse(received)) is not None:
                received = received[answer.end :]
                if answer.error:
                    raise BusError(f"servo {answer.servo} reports error {answer.error}")
                if answer.servo in expected and len(answer.data) == size:
                    answers[answer.servo] = answer.data
        return answers

    @abstractmethod
    def packet(self, servo: int, instruction: int, parameters: bytes) -> bytes:
        """Return the packet of an instruction."""

    @abstractmethod
    def parse(self, received: bytes) -> Answer | None:
        """Return the first complete status packet; None if there is none. Damaged ones are skipped."""

    @abstractmethod
    def decode(self, data: bytes) -> int:
        """Return the number in a register."""

    @abstractmethod
    def encode_force(self, counts: int) -> int:
        """Return the value of the register `force`."""

    @abstractmethod
    def _numbers(self, *values: int) -> bytes:
        """Return addresses and sizes as parameters."""


class Feetech(Bus):
    """STS and SMS series, such as the STS3215. Force: duty cycle in 0.1 %; the manual has no watchdog."""

    enable, mode, force, position = Register(40, 1), Register(33, 1), Register(44, 2), Register(56, 2)
    force_mode, force_max = 2, 1000  # 100 %
    SIGN: Final = 1 << 10

    def packet(self, servo: int, instruction: int, parameters: bytes) -> bytes:
        body = bytes([servo, len(parameters) + 2, instruction]) + parameters
        return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])

    def parse(self, received: bytes) -> Answer | None:
        start = received.find(b"\xff\xff")
        while start >= 0 and len(received) >= start + 4:
            end = start + 4 + received[start + 3]
            if len(received) < end:
                return None
            if sum(received[start + 2 : end]) & 0xFF == 0xFF and end - start >= 6:
                return Answer(received[start + 2], received[start + 4], received[start + 5 : end - 1], end)
            start = received.find(b"\xff\xff", start + 1)
        return None

    def decode(self, data: bytes) -> int:
        number = int.from_bytes(data, "little")
        return -(number & 0x7FFF) if len(data) == 2 and number & 0x8000 else number

    def encode_force(self, counts: int) -> int:
        return abs(counts) | self.SIGN if counts < 0 else counts

    def _numbers(self, *values: int) -> bytes:
        return bytes(values)


class Dynamixel(Bus):
    """X series, such as the XL330. Force: current in mA."""

    enable, mode, force, position = Register(64, 1), Register(11, 1), Register(102, 2), Register(132, 4)
    watchdog = Register(98, 1)
    force_mode, force_max = 0, 1750  # mA: the largest Current Limit of an XL330 in Robotis' manual
    HEAD: Final = b"\xff\xff\xfd\x00"
    STUFFING: Final = (b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")

    def packet(self, servo: int, instruction: int, parameters: bytes) -> bytes:
        body = bytes([instruction]) + parameters.replace(*self.STUFFING)
        packet = self.HEAD + bytes([servo]) + struct.pack("<H", len(body) + 2) + body
        return packet + struct.pack("<H", crc16(packet))

    def parse(self, received: bytes) -> Answer | None:
        start = received.find(self.HEAD)
        while start >= 0 and len(received) >= start + 7:
            end = start + 7 + int.from_bytes(received[start + 5 : start + 7], "little")
            if len(received) < end:
                return None
            packet = received[start:end]
            if len(packet) >= 11 and struct.pack("<H", crc16(packet[:-2])) == packet[-2:]:
                # Bit 7 of the error is an alert about the hardware, which the register Hardware Error Status explains.
                return Answer(packet[4], packet[8] & 0x7F, packet[9:-2].replace(*reversed(self.STUFFING)), end)
            start = received.find(self.HEAD, start + 1)
        return None

    def decode(self, data: bytes) -> int:
        return int.from_bytes(data, "little", signed=len(data) > 1)

    def encode_force(self, counts: int) -> int:
        return counts

    def _numbers(self, *values: int) -> bytes:
        return struct.pack(f"<{len(values)}H", *values)


def _crc_of(byte: int) -> int:
    crc = byte << 8
    for _ in range(8):
        crc = (crc << 1) ^ (0x8005 if crc & 0x8000 else 0)
    return crc & 0xFFFF


_CRC_TABLE: Final = [_crc_of(byte) for byte in range(256)]


def crc16(data: bytes) -> int:
    """Return the CRC of protocol 2.0: polynomial 0x8005, start 0, not reflected."""
    crc = 0
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ _CRC_TABLE[crc >> 8 ^ byte]
    return crc
