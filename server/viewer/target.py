"""Targets of a hand, and their change by drags and increments."""

from __future__ import annotations

from math import asin, atan2
from typing import Final, NamedTuple

import numpy as np

from softfinger.config.arrays import Array
from softfinger.drivers.quaternions import exp, multiply
from softfinger.server.viewer.inputs import Nudge
from softfinger.server.viewer.nodes.below import UP

MIN_VIEW_SINE: Final = 0.05
"""Minimum sine of the angle between view ray and plane; below it, one pixel would be a long distance."""


class Target(NamedTuple):
    """Target of a hand: position (3,) m and orientation (4,)."""

    position: Array
    orientation: Array


def intersect_plane(eye: Array, through: Array, point: Array, normal: Array) -> Array | None:
    """Return the point where the ray from `eye` through a point meets the plane of `point` and `normal`.

    None if the ray is nearly parallel to the plane or points away from it.
    """
    ray = through - eye
    slope = float(ray @ normal) / float(np.linalg.norm(ray) * np.linalg.norm(normal))
    if abs(slope) < MIN_VIEW_SINE:
        return None
    scale = float((point - eye) @ normal) / float(ray @ normal)
    return eye + scale * ray if scale > 0.0 else None


def drag_target(start: Target, eye: Array, grabbed: Array, pointer: Array, mode: str, radius: float) -> Target | None:
    """Return the target after a drag from `start`, all positions (3,) m; None if the ray misses the drag plane.

    mode  "move" in a horizontal plane, "press" up and down, or "roll", as a ball of `radius` on a horizontal plane
    """
    if mode == "press":
        facing = (grabbed - eye) * (1.0, 1.0, 0.0)
        if np.linalg.norm(facing) < MIN_VIEW_SINE * np.linalg.norm(grabbed - eye):
            return None
        hit_point = intersect_plane(eye, pointer, grabbed, facing)
        return None if hit_point is None else Target(start.position + UP * (hit_point - grabbed)[2], start.orientation)
    hit_point = intersect_plane(eye, pointer, grabbed, UP)
    if hit_point is None:
        return None
    displacement = (hit_point - grabbed) * (1.0, 1.0, 0.0)
    if mode == "move":
        return Target(start.position + displacement, start.orientation)
    roll = exp(np.cross(UP, displacement) / radius)
    return Target(start.position + displacement, multiply(roll, start.orientation))


def nudge_target(start: Target, nudge: Nudge, radius: float) -> Target:
    """Return the target moved by an increment; a ball of `radius` (m) for rolling."""
    roll = np.array([nudge.roll_x, nudge.roll_y, 0.0])
    rotation = multiply(exp(nudge.spin * UP), exp(np.cross(UP, roll) / radius))
    return Target(start.position + roll + (nudge.x, nudge.y, nudge.z), multiply(rotation, start.orientation))


def mirror_motion(displacement: Array, line: Array) -> Array:
    """Return the mirrored motion (3,) m: the component along `line`, between two fingers, is reversed."""
    length = float(line @ line)
    return displacement if length == 0.0 else displacement - 2.0 * float(displacement @ line) / length * line


def move_towards(position: Array, centre: Array, distance_m: float) -> Array:
    """Return a position (3,) m moved by `distance_m` towards the centre of all fingers, and not past it."""
    offset = centre - position
    remaining = float(np.linalg.norm(offset))
    return position if remaining == 0.0 else position + min(distance_m, remaining) / remaining * offset


def from_angles(roll_x: float, roll_y: float, spin: float) -> Array:
    """Return the rotation (4,) about the world axes x, then y, then z; rad."""
    x, y, z = exp(np.diag((roll_x, roll_y, spin)))
    return multiply(z, multiply(y, x))


def to_angles(q: Array) -> tuple[float, float, float]:
    """Return the angles of `from_angles`, rad."""
    w, x, y, z = q
    return (
        atan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)),
        asin(min(max(2.0 * (w * y - z * x), -1.0), 1.0)),
        atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)),
    )
