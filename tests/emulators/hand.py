"""Handle of an emulated device with a hand on it. Pure Python."""

from collections.abc import Callable
from math import cos, pi

Vector = tuple[float, float, float]

STEP_S = 0.001
SUBSTEPS = 4


class Handle:
    """A mass with bearing friction, and a hand that pulls it toward its goal.

    Each packet of the host moves it by one millisecond, so that a slow connection changes no physics.

    intention  goal (m, device's frame) of the hand at a time (s)
    """

    mass, bearing, hand_spring, hand_damper = 0.15, 1.5, 300.0, 8.0

    def __init__(self, intention: Callable[[float], Vector]) -> None:
        self.intention = intention
        self.place, self.speed = intention(0.0), (0.0, 0.0, 0.0)
        self.steps = 0

    def move(self, motors: Vector) -> None:
        """Run one step under a force (N) of the motors."""
        wanted = self.intention(self.steps * STEP_S)
        h = STEP_S / SUBSTEPS
        for _ in range(SUBSTEPS):
            pull = [
                f + self.hand_spring * (w - p) - (self.hand_damper + self.bearing) * v
                for f, w, p, v in zip(motors, wanted, self.place, self.speed, strict=True)
            ]
            vx, vy, vz = (v + h * f / self.mass for v, f in zip(self.speed, pull, strict=True))
            self.speed = (vx, vy, vz)
            x, y, z = (p + h * v for p, v in zip(self.place, self.speed, strict=True))
            self.place = (x, y, z)
        self.steps += 1


def stroke(place: Vector, press: float, drag: float) -> Callable[[float], Vector]:
    def smooth(share: float) -> float:
        return 0.5 - 0.5 * cos(pi * min(max(share, 0.0), 1.0))

    def at(time_s: float) -> Vector:
        t = time_s % 1.2
        depth = smooth(t / 0.3) - smooth((t - 0.9) / 0.3)
        side = smooth((t - 0.3) / 0.3) - smooth((t - 0.6) / 0.3)
        return (place[0] + drag * side, place[1], place[2] - press * depth)

    return at
