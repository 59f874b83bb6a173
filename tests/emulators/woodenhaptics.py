"""WoodenHaptics arm with a hand on it, behind its two wire formats. Pure Python: it also runs under the system's.

Written from the published wire formats and dimensions, independent of the driver. Each report of the host moves the arm
by one millisecond, so that a slow connection changes no physics, and is answered with the encoders.
"""

import struct
import time
from collections.abc import Callable
from math import acos, atan2, cos, hypot, pi, sin

from emulators.hand import Handle, Vector

# capstans (mm), links (m), bodies (mm), origin (m), torque constants (N m/A), counts per turn, calibration, aligned
TABLE: dict[str, tuple[Vector, Vector, Vector, Vector, Vector, int, tuple[int, int, int], tuple[int, int, int]]] = {
    "woody-2019": (
        (10, 10, 10), (0.080, 0.205, 0.245), (160, 120, 120), (0.22, 0, 0.08), (0.321, 0.0603, 0.0603), 2000,
        (0, 0, 6000), (0, 0, 0),
    ),
    "woody-2015": (
        (10, 10, 10), (0.080, 0.205, 0.245), (160, 120, 120), (0.22, 0, 0.08), (0.0259, 0.0259, 0.0259), 2000,
        (0, 0, 6000), (0, 0, 0),
    ),
    "polhem-v1": (
        (10, 10, 10), (0.058, 0.174, 0.133), (180, 100, 100), (0.14, 0, 0.10), (0.0538, 0.0538, 0.0538), 2000,
        (0, 0, -5000), (1, 1, 1),
    ),
    "aluhaptics-v2": (
        (13.8, 9.8, 9.8), (0.111, 0.140, 0.111), (116, 76, 76), (0.14, 0, 0), (0.0259, 0.0259, 0.0259), 2000,
        (0, 0, 0), (0, 0, 0),
    ),
    "vintage": (
        (13, 10, 10), (0.056, 0.138, 0.112), (117, 77, 77), (0.14, 0, 0), (0.0163, 0.0163, 0.0163), 4000,
        (0, 0, 0), (0, 0, 0),
    ),
}  # fmt: skip


class Arm:
    def __init__(self, name: str) -> None:
        capstan, self.link, body, self.origin, self.torque_constant, self.counts_per_turn, calibration, aligned = TABLE[
            name
        ]
        self.calibration = calibration
        self.ratio = [(-1 if x else 1) * c / b for x, c, b in zip(aligned, capstan, body, strict=True)]

    def position(self, angles: Vector) -> Vector:
        """Return the position of the end (m): the links end to end, rotated about the vertical."""
        la, lb, lc = self.link
        a, b, c = angles
        across = lb * sin(b) + lc * cos(c - pi / 2)
        up = la + lb * cos(b) + lc * sin(c - pi / 2)
        return (across * cos(a) - self.origin[0], across * sin(a) - self.origin[1], up - self.origin[2])

    def angles(self, position: Vector) -> Vector:
        la, lb, lc = self.link
        x, y, z = (p + o for p, o in zip(position, self.origin, strict=True))
        across, up = hypot(x, y), z - la
        # The outer angle between the links is pi - (B + C).
        both = acos((lb * lb + lc * lc - across * across - up * up) / (2 * lb * lc))
        b = atan2(across, up) - atan2(lc * sin(both), lb - lc * cos(both))
        return (atan2(y, x), b, both - b)

    def counts(self, position: Vector) -> tuple[int, int, int]:
        per_radian = self.counts_per_turn / (2 * pi)
        n = [round(angle / r * per_radian) for angle, r in zip(self.angles(position), self.ratio, strict=True)]
        return (n[0], n[1], n[2])

    def angles_at(self, counts: tuple[int, int, int]) -> Vector:
        a, b, c = (2 * pi * n / self.counts_per_turn * r for n, r in zip(counts, self.ratio, strict=True))
        return (a, b, c)

    def force(self, position: Vector, amperes: Vector) -> Vector:
        """Return the force (N) of the motors at the end: J^T f = tau, with J from differences of `position`."""
        angles = self.angles(position)
        tau = [i * k / r for i, k, r in zip(amperes, self.torque_constant, self.ratio, strict=True)]
        h, rows = 1e-6, []
        for joint in range(3):
            ahead, behind = list(angles), list(angles)
            ahead[joint] += h
            behind[joint] -= h
            p, q = self.position((*ahead,)), self.position((*behind,))
            rows.append([(u - v) / (2 * h) for u, v in zip(p, q, strict=True)])
        return _solve(rows, tau)


def _solve(m: list[list[float]], v: list[float]) -> Vector:
    def det(r: list[list[float]]) -> float:
        return (
            r[0][0] * (r[1][1] * r[2][2] - r[1][2] * r[2][1])
            - r[0][1] * (r[1][0] * r[2][2] - r[1][2] * r[2][0])
            + r[0][2] * (r[1][0] * r[2][1] - r[1][1] * r[2][0])
        )

    whole = det(m)
    x, y, z = (
        det([[v[i] if j == column else m[i][j] for j in range(3)] for i in range(3)]) / whole for column in range(3)
    )
    return (x, y, z)


class Woody(Handle):
    """Arm with a hand on it; `name` is a row of the table, `report_bytes` 8 (generation 1), 64 or 14 (generation 2)."""

    def __init__(
        self, name: str, generation: int, intention: Callable[[float], Vector], report_bytes: int | None = None
    ) -> None:
        super().__init__(intention)
        self.report_bytes = report_bytes or {1: 8, 2: 64}[generation]
        self.arm, self.generation = Arm(name), generation
        self.milliamperes: tuple[int, int, int] = (0, 0, 0)
        self.wrist = (0, 0, 0)
        self.zero = (0, 0, 0)
        """Displayed counts minus true ones: not 0 before calibration."""
        self.sent: list[tuple[int, ...]] = []
        """Numbers of every report of the host."""
        self.sent_at: list[float] = []
        """Times (s, monotonic clock) of these reports."""

    def answer(self, report: bytes) -> bytes:
        if len(report) != self.report_bytes + 1 or report[0] != 0:
            raise ValueError(
                f"a host's report has 0 and {self.report_bytes} bytes, this has {report[:1]!r}, {len(report)}"
            )
        words = struct.unpack_from("<4h" if self.generation == 1 else "<7h", report, 1)
        self.sent_at.append(time.monotonic())
        self.sent.append(words)
        if self.generation == 2 and words[3] == 1:
            true = self.arm.counts(self.place)
            self.zero = (words[4] - true[0], words[5] - true[1], words[6] - true[2])
            self.wrist = (words[0], words[1], words[2])  # the same command sets all six encoders
            self.milliamperes = (0, 0, 0)
        else:
            self.milliamperes = (words[0], words[1], words[2])
        a, b, c = (m / 1e3 for m in self.milliamperes)
        self.move(self.arm.force(self.place, (a, b, c)))
        return self.report()

    def report(self) -> bytes:
        a, b, c = (n + z for n, z in zip(self.arm.counts(self.place), self.zero, strict=True))
        if self.generation == 1:
            return struct.pack("<3hH", -a, b, c, 0)
        return struct.pack("<7h", a, b, c, *self.wrist, 0).ljust(self.report_bytes, b"\0")
