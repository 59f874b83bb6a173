"""Chain of bus servos behind a pseudo terminal, in real time: Feetech STS (protocol 0) or Dynamixel X (protocol 2.0).

Written from the makers' manuals, as public tables and libraries quote them (Feetech: FT-SMS-STS memory table; Robotis:
e-Manual, protocol 2.0 and the X series' control table), independent of the driver. A byte takes ten bits of the baud
rate, each answer starts after the servo's return delay, and the servos of a sync read answer one after another.

Not modelled: the time of USB (about 1 ms per transaction), collisions on the half-duplex line, the dynamics of motors,
EEPROM and its lock, and registers except those below.
"""

import struct
import time
from typing import NamedTuple

from emulators.farterminal import FarTerminal

BROADCAST = 254
WRITE, SYNC_READ = 0x03, 0x82


class Registers(NamedTuple):
    enable: int
    mode: int
    force: int
    position: int
    watchdog: int
    """0 if there is none."""
    force_mode: int


FEETECH = Registers(enable=40, mode=33, force=44, position=56, watchdog=0, force_mode=2)
DYNAMIXEL = Registers(enable=64, mode=11, force=102, position=132, watchdog=98, force_mode=0)
WATCHDOG_UNIT_S = 0.02
EXPIRED = 0xFF
"""Value of an expired watchdog: the servo refuses goals until it is 0."""
RANGE_ERROR = 4


def crc16(data: bytes) -> int:
    crc = 0
    for byte in data:
        crc ^= byte << 8
        for _ in range(8):
            crc = (crc << 1 ^ 0x8005 * (crc >> 15)) & 0xFFFF
    return crc


class Servo:
    def __init__(self, table: Registers, position: int) -> None:
        self.table, self.memory = table, bytearray(256)
        self.memory[table.mode] = table.force_mode
        self.turn_to(position)
        self.heard_at = time.monotonic()
        self.mute = False
        """If set, the servo receives but does not answer."""
        self.log: list[tuple[float, int]] = []
        """Time (s, monotonic clock) and counts of each change of the motor."""

    def turn_to(self, position: int) -> None:
        struct.pack_into("<H" if self.table is FEETECH else "<i", self.memory, self.table.position, position)

    def force(self, now: float) -> int:
        """Return the motor's output: PWM in 0.1 % with bit 10 for the sign (Feetech), or mA (Dynamixel)."""
        if not self.memory[self.table.enable] or self.memory[self.table.mode] != self.table.force_mode:
            return 0
        if self.table is FEETECH:
            (raw,) = struct.unpack_from("<H", self.memory, self.table.force)
            return -(raw & 0x3FF) if raw & 0x400 else raw & 0x3FF
        self.watch(now)
        return (
            0
            if self.memory[self.table.watchdog] == EXPIRED
            else int(struct.unpack_from("<h", self.memory, self.table.force)[0])
        )

    def watch(self, now: float) -> None:
        limit_s = self.memory[self.table.watchdog] * WATCHDOG_UNIT_S if self.table.watchdog else 0.0
        if limit_s and self.memory[self.table.enable] and now - self.heard_at > limit_s:
            self.memory[self.table.watchdog] = EXPIRED

    def store(self, address: int, data: bytes, now: float) -> int:
        """Store a register; return the error of the answer."""
        if address == self.table.force and self.table.watchdog and self.memory[self.table.watchdog] == EXPIRED:
            return RANGE_ERROR
        before = self.force(now)
        self.memory[address : address + len(data)] = data
        if (after := self.force(now)) != before:
            self.log.append((now, after))
        return 0


class BusServos(FarTerminal):
    def __init__(
        self, table: Registers, positions: dict[int, int], baud: int = 1_000_000, delay_s: float = 0.0
    ) -> None:
        super().__init__(period_s=0.0001)
        self.table, self._byte_s, self.delay_s = table, 10.0 / baud, delay_s
        self.servos = {number: Servo(table, position) for number, position in positions.items()}
        self.damage: dict[int, int] = {}
        """Number of the next answers with a wrong checksum, by id."""
        self.stray = b""
        """Bytes in front of each answer, such as a late one."""
        self._rest, self._free_at = b"", 0.0
        self.requests = 0

    def turn(self) -> None:
        self._rest += self.read()
        while (packet := self._packet()) is not None:
            number, instruction, parameters, size = packet
            now = time.monotonic()
            self._free_at = max(self._free_at, now) + size * self._byte_s
            self.requests += 1
            for servo in self.servos.values():
                servo.watch(now)
                servo.heard_at = now
            self._execute(number, instruction, parameters, now)

    def _execute(self, number: int, instruction: int, parameters: bytes, now: float) -> None:
        wide = 2 if self.table is DYNAMIXEL else 1
        address = int.from_bytes(parameters[:wide], "little")
        if instruction == SYNC_READ and number == BROADCAST:
            size = int.from_bytes(parameters[wide : 2 * wide], "little")
            for parameter in parameters[2 * wide :]:
                if parameter not in self.servos:
                    return  # the next servo waits for its answer, and all after it
                self._answer(parameter, bytes(self.servos[parameter].memory[address : address + size]))
        elif instruction == WRITE and number in self.servos:
            self._answer(number, b"", self.servos[number].store(address, parameters[wide:], now))

    def _answer(self, number: int, data: bytes, error: int = 0) -> None:
        if self.servos[number].mute:
            return
        packet = self.encode(number, data, error)
        if self.damage.get(number, 0):
            self.damage[number] -= 1
            packet = packet[:-1] + bytes([packet[-1] ^ 0x55])
        self._free_at += self.delay_s + len(packet) * self._byte_s
        time.sleep(max(0.0, self._free_at - time.monotonic()))
        self.say(self.stray + packet)

    def encode(self, number: int, data: bytes, error: int = 0) -> bytes:
        """Return a status packet."""
        if self.table is FEETECH:
            body = bytes([number, len(data) + 2, error]) + data
            return b"\xff\xff" + body + bytes([~sum(body) & 0xFF])
        body = bytes([0x55, error]) + data
        packet = b"\xff\xff\xfd\x00" + bytes([number]) + struct.pack("<H", len(body) + 2) + body
        return packet + struct.pack("<H", crc16(packet))

    def _packet(self) -> tuple[int, int, bytes, int] | None:
        mark, head = (b"\xff\xff", 4) if self.table is FEETECH else (b"\xff\xff\xfd\x00", 7)
        while (start := self._rest.find(mark)) >= 0 and len(self._rest) >= start + head:
            self._rest = self._rest[start:]
            length = self._rest[3] if self.table is FEETECH else int.from_bytes(self._rest[5:7], "little")
            if len(self._rest) < head + length:
                return None
            packet, self._rest = self._rest[: head + length], self._rest[head + length :]
            if self.table is FEETECH and sum(packet[2:]) & 0xFF == 0xFF:
                return packet[2], packet[4], packet[5:-1], len(packet)
            if self.table is DYNAMIXEL and crc16(packet[:-2]) == int.from_bytes(packet[-2:], "little"):
                return packet[4], packet[7], packet[8:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"), len(packet)
        return None
