"""Falcon with a hand on its knob, behind its serial chip. Pure Python: it also runs under the system's interpreter.

Written from the published packets, dimensions and boot sequence, independent of the driver. Each packet of the host
moves the knob by one millisecond, so that a slow connection changes no physics, and is answered with the encoders. The
device's frame has x to the right, y up, z out to the user.
"""

import random
from collections.abc import Callable
from math import acos, atan2, cos, degrees, hypot, pi, radians, sin, sqrt
from typing import Any

from emulators.hand import Handle, Vector, stroke

UPPER, LOWER = 0.060, 0.1025  # driven arm, parallelogram: m
PIVOTS = 0.01125  # from each end of the parallelogram to its arm: m, twice
SHIFT_V, SHIFT_U = 0.025, 0.01443  # of the legs' ends on the moving plate: m
BASE_U, BASE_V = 0.0400, -0.02309  # of the legs' motors on the base: m
LEGS = (105.0, -15.0, -135.0)  # degrees about z
CENTRE = (0.0, 0.0, 0.11)
INDEX = 700
"""Encoder count of a leg's homing switch: near the outer end of the knob's range."""


def leg_angle(leg: float, place: Vector) -> float:
    """Return the angle (rad) of a driven arm, from the triangle of arm, parallelogram and connecting line."""
    x, y, z = place
    turn = radians(leg)
    u = x * cos(turn) + y * sin(turn) - BASE_U + SHIFT_U
    v = y * cos(turn) - x * sin(turn) - BASE_V - SHIFT_V
    reach = 2 * PIVOTS + sqrt(LOWER**2 - v**2)  # the parallelogram leans sideways by v
    line = hypot(u, z)
    return atan2(z, u) + acos((UPPER**2 + line**2 - reach**2) / (2 * UPPER * line)) * ELBOW


ELBOW = -1
"""The arms bend outward."""


def encoders(place: Vector) -> tuple[int, int, int]:
    per_count = 0.01425 / 0.110 * 360 / 1280
    a, b, c = (round((degrees(leg_angle(leg, place)) - 35) / per_count) for leg in LEGS)
    return a, b, c


def force(place: Vector, torques: Vector) -> Vector:
    """Return the force (N) on the knob for leg torques (N m): virtual work, with differences of the angles."""
    h, out = 1e-6, []
    for axis in range(3):
        ahead, behind = list(place), list(place)
        ahead[axis] += h
        behind[axis] -= h
        turn = [leg_angle(leg, (*ahead,)) - leg_angle(leg, (*behind,)) for leg in LEGS]
        out.append(sum(t * d for t, d in zip(torques, turn, strict=True)) / (2 * h))
    x, y, z = out
    return (x, y, z)


class Falcon(Handle):
    """The device behind its serial chip.

    intention   goal (m, device's frame) of the hand at a time (s)
    gain        motor counts per N m at a leg, negative if they pull in
    firmware    bytes that it needs before it runs; None: it runs
    spoil       number of firmware loads with a wrong echo
    homed       True if its encoders have found their zeros
    """

    def __init__(
        self, intention: Callable[[float], Vector], gain: float = -10000.0, firmware: bytes | None = None,
        spoil: int = 0, homed: bool = True,
    ) -> None:  # fmt: skip
        super().__init__(intention)
        self.gain, self.firmware, self.spoil = gain, firmware, spoil
        self.runs = firmware is None
        self.found = [homed] * 3
        self.zero = (0, 0, 0) if homed else encoders(self.place)
        self.motors: tuple[int, int, int] = (0, 0, 0)
        self.state = 0
        self.buttons = 0
        self.weight = 0.0
        """Weight (N) at the knob."""
        self.most = [0, 0, 0]
        self.requests: list[tuple[int, int]] = []
        self.baud = self.latency_ms = 0
        self.loading = "deaf"
        self.loads = 0
        self.loaded = bytearray()
        self.stream = bytearray()
        self.reply = bytearray()
        """Bytes in the chip for the host."""

    @property
    def displayed(self) -> Vector:
        """Force (N) on the hand now, device's frame."""
        a, b, c = (n / self.gain for n in self.motors)
        return force(self.place, (a, b, c))

    @property
    def at(self) -> Vector:
        """Position of the knob (m) in the world, from the workspace's centre."""
        x, y, z = (p - c for p, c in zip(self.place, CENTRE, strict=True))
        return to_world((x, y, z))

    def unplugged(self) -> None:
        self.motors, self.baud, self.latency_ms = (0, 0, 0), 0, 0
        self.stream.clear()
        self.reply.clear()

    def seen(self) -> dict[str, Any]:
        return {
            "steps": self.steps, "motors": self.motors, "most": self.most, "state": self.state, "place": self.place,
            "runs": self.runs, "loads": self.loads, "requests": self.requests[:6], "found": self.found,
        }  # fmt: skip

    def request(self, kind: int, request: int, value: int, index: int) -> None:
        if (kind, index) != (0x40, 0):
            raise ValueError(f"no request of the chip: {kind:#x}, index {index}")
        self.requests.append((request, value))
        if request == 0:
            if value == 1:
                self.reply.clear()
        elif request == 9:
            self.latency_ms = value
        elif request == 3:
            self.baud = value
            if self.loading == "loads" and value == 0x0002:
                self.runs = self.loaded == self.firmware
                self.loading = "deaf"
        elif request == 1 and value == 0x0101 and not self.runs:
            self.loading, self.loads = "resets", self.loads + 1
            self.loaded.clear()

    def write(self, data: bytes) -> None:
        if not self.runs:
            self._load(data)
        elif self.baud == 0x0002:
            for byte in data:
                self._take(byte)

    def read(self, count: int) -> bytes:
        data = bytes(self.reply[: count - 2])
        del self.reply[: count - 2]
        return b"\x01\x60" + data

    def _load(self, data: bytes) -> None:
        if self.loading == "resets" and self.baud == 0x4138 and data == b"\x0aC\x0d":
            self.loading = "greeted"
            self.reply += b"\0\x0aD,\x0d" if self.loads % 2 else b"\x0aD,\x0d"
        elif self.loading == "greeted" and self.baud == 0x0015 and data == b"A":
            self.loading = "loads"
            self.reply += b"A"
        elif self.loading == "loads" and self.baud == 0x0015:
            echo = bytearray(data)
            if self.loads <= self.spoil and len(self.loaded) > 3000:
                echo[-1] ^= 0x10
            self.loaded += data
            self.reply += echo

    def _take(self, byte: int) -> None:
        self.stream.append(byte)
        if self.stream[0] != ord("<"):
            self.stream.clear()
        if len(self.stream) < 16:
            return
        packet, self.stream = bytes(self.stream), bytearray()
        if packet[15] != ord(">") or not all(0x41 <= b <= 0x50 for b in packet[1:15]):
            raise ValueError(f"no packet of a host: {packet!r}")
        counts = []
        for n in range(3):
            value = int("".join(f"{b - 0x41:x}" for b in reversed(packet[1 + 4 * n : 5 + 4 * n])), 16)
            counts.append(value - 65536 if value > 32767 else value)
        self.motors = (counts[0], counts[1], counts[2])
        self.most = [max(m, abs(c)) for m, c in zip(self.most, counts, strict=True)]
        self.state = packet[13] - 0x41
        x, y, z = self.displayed
        self.move((x, y - self.weight, z))
        shown = encoders(self.place)
        if self.state & 1:
            for n in range(3):
                self.found[n] = self.found[n] or shown[n] > INDEX
        if all(self.found):
            self.zero = (0, 0, 0)
        counts = [c - z for c, z in zip(shown, self.zero, strict=True)]
        homed = sum(1 << n for n in range(3) if self.found[n])
        body = b"".join(bytes(0x41 + (c >> (4 * k) & 15) for k in range(4)) for c in counts)
        self.reply += b"<" + body + bytes([0x41 + (homed << 4 | self.buttons), 0x41]) + b">"


def to_world(of_device: Vector) -> Vector:
    right, up, out = of_device
    return (right, -out, up)


def from_case(case: dict[str, Any]) -> Falcon:
    """Return the device and hand of a test case.

    place (m, world), press (m: downward motion of the hand), drag (m: sideways motion), homed (false: the hand homes
    it), gain (motor counts per N m), firmware (number of bytes it needs first), spoil (loads with a wrong echo), hand
    (false: the knob is free).
    """
    world = stroke(tuple(case.get("place", (0.0, 0.0, 0.01))), case.get("press", 0.0), case.get("drag", 0.0))

    def intention(at: float) -> Vector:
        right, away, up = world(at)
        return (CENTRE[0] + right, CENTRE[1] + up, CENTRE[2] - away)

    homed, firmware = case.get("homed", True), case.get("firmware")
    falcon = Falcon(
        intention if homed else homing(intention), case.get("gain", -10000.0),
        None if firmware is None else random.Random(firmware).randbytes(firmware), case.get("spoil", 0), homed,
    )  # fmt: skip
    if not case.get("hand", True):
        falcon.hand_spring = falcon.hand_damper = 0.0
    return falcon


def homing(then: Callable[[float], Vector]) -> Callable[[float], Vector]:
    def at(time_s: float) -> Vector:
        if time_s > 2.0:
            return then(time_s - 2.0)
        out = 0.5 - 0.5 * cos(pi * time_s)
        x, y, z = then(0.0)
        return (x, y, z + (0.175 - z) * out)

    return at
