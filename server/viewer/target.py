"""Targets of a hand, and their change by drags and increments."""

from __future__ import annotations

from math import asin, atan2
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.server.viewer.inputs import Nudge
from softfinger.server.viewer.nodes.glyphs import UNTURNED, Quaternion, about, product

Array = NDArray[np.float64]

GRAZING: Final = 0.05
"""Minimum sine of the angle between view ray and plane; below it, one pixel would be a long distance."""


class Target(NamedTuple):
    """Target of a hand: position (3,) m and orientation."""

    position: Array
    orientation: Quaternion


def hit(eye: Array, through: Array, point: Array, normal: Array) -> Array | None:
    """Return the point where the ray from `eye` through a point meets the plane of `point` and `normal`.

    None if the ray is nearly parallel to the plane or points away from it.
    """
    look = through - eye
    slope = float(look @ normal) / float(np.linalg.norm(look) * np.linalg.norm(normal))
    if abs(slope) < GRAZING:
        return None
    way = float((point - eye) @ normal) / float(look @ normal)
    return eye + way * look if way > 0.0 else None


def moved(start: Target, eye: Array, grabbed: Array, pointer: Array, how: str, radius: float) -> Target | None:
    """Return the target after a drag from `start`, all positions (3,) m; None if the ray misses the drag plane.

    how  "move" in a horizontal plane, "press" up and down, or "roll", as a ball of `radius` on a horizontal plane
    """
    up = np.array([0.0, 0.0, 1.0])
    if how == "press":
        facing = (grabbed - eye) * (1.0, 1.0, 0.0)
        if np.linalg.norm(facing) < GRAZING * np.linalg.norm(grabbed - eye):
            return None
        found = hit(eye, pointer, grabbed, facing)
        return None if found is None else Target(start.position + up * (found - grabbed)[2], start.orientation)
    found = hit(eye, pointer, grabbed, up)
    if found is None:
        return None
    way = (found - grabbed) * (1.0, 1.0, 0.0)
    if how == "move":
        return Target(start.position + way, start.orientation)
    return Target(start.position + way, product(rolled(way, radius), start.orientation))


def rolled(way: Array, radius: float) -> Quaternion:
    """Return the rotation of a ball that rolls horizontally by `way` (3,) m; the identity for zero."""
    length = float(np.linalg.norm(way))
    return UNTURNED if length == 0.0 else about(np.cross((0.0, 0.0, 1.0), way), length / radius)


def nudged(start: Target, nudge: Nudge, radius: float) -> Target:
    """Return the target moved by an increment; a ball of `radius` (m) for rolling."""
    roll = np.array([nudge.roll_x, nudge.roll_y, 0.0])
    turn = product(about(np.array([0.0, 0.0, 1.0]), nudge.spin), rolled(roll, radius))
    return Target(start.position + roll + (nudge.x, nudge.y, nudge.z), product(turn, start.orientation))


def mirrored(way: Array, line: Array) -> Array:
    """Return the mirrored motion (3,) m of `way`: its component along `line`, between two fingers, is reversed."""
    length = float(line @ line)
    return way if length == 0.0 else way - 2.0 * float(way @ line) / length * line


def closed(place: Array, middle: Array, way: float) -> Array:
    """Return a position (3,) m moved by `way` m towards the centre of all fingers, and not past it."""
    apart = middle - place
    distance = float(np.linalg.norm(apart))
    return place if distance == 0.0 else place + min(way, distance) / distance * apart


def from_angles(roll_x: float, roll_y: float, spin: float) -> Quaternion:
    """Return the rotation about the world axes x, then y, then z; rad."""
    x, y, z = (np.array(axis, dtype=np.float64) for axis in ((1, 0, 0), (0, 1, 0), (0, 0, 1)))
    return product(about(z, spin), product(about(y, roll_y), about(x, roll_x)))


def to_angles(q: Quaternion) -> tuple[float, float, float]:
    """Return the angles of `from_angles`, rad."""
    w, x, y, z = q
    return (
        atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0)),
        atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )
