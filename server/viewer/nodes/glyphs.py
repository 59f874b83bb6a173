"""Line drawings of moments (arcs), rotations (marks) and paths of contacts (traces); rotations of points."""

from __future__ import annotations

from math import copysign, cos, pi, sin, sqrt
from typing import Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config.arrays import Array

Quaternion = tuple[float, float, float, float]
PoseTuple = tuple[tuple[float, float, float], Quaternion]
"""Position (3,) m and orientation."""

ARC_PIECES: Final = 32
ARC_MAX: Final = 1.85 * pi
"""A closed arc would not show its end."""
HEAD_RAD: Final = 0.32
"""Length of an arc's arrow head."""

DASHES: Final = 8
GROWTH: Final = 20
"""Segments by which the node of a trace grows."""
MAX_SEGMENT_STEPS: Final = 25.0
"""Maximum length of a segment, in steps: 5 mm."""
MAX_DEVIATION_STEPS: Final = 0.12
"""Maximum distance of an omitted point from its segment, in steps: 0.02 mm, or a fifth of a pixel."""


def make_arc(angle: float, radius: float) -> Array:
    """Return segments (ARC_PIECES + 2, 2, 3) of an arc about +z from the x axis, with an arrow head at its end.

    angle  rad  right-handed; at most ARC_MAX of it is drawn
    """
    angle = copysign(min(abs(angle), ARC_MAX), angle)
    turn = np.linspace(0.0, angle, ARC_PIECES + 1)
    line = radius * np.column_stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)])
    head_start = angle - copysign(min(HEAD_RAD, 0.6 * abs(angle)), angle)
    barbs = [(r * radius * cos(head_start), r * radius * sin(head_start), 0.0) for r in (0.82, 1.18)]
    head = [(line[-1], barb) for barb in barbs]
    return np.concatenate([np.stack([line[:-1], line[1:]], axis=1), np.array(head)])


def make_dashes(start: Array, displacement: Array) -> Array:
    """Return segments (DASHES, 2, 3) of a line from `start` (3,) to `start + displacement` with a dash at both ends."""
    share = np.linspace(0.0, 1.0, 2 * DASHES)
    return (start + share[:, None] * displacement).reshape(DASHES, 2, 3)


def make_circles(radii: tuple[float, float, float], pieces: int = 32) -> Array:
    """Return segments (3 pieces, 2, 3) of the intersections of an ellipsoid with its principal planes."""
    turn = np.linspace(0.0, 2.0 * pi, pieces + 1)
    c, s, none = np.cos(turn), np.sin(turn), np.zeros_like(turn)
    lines = [np.column_stack(circle) * radii for circle in ((c, s, none), (none, c, s), (s, none, c))]
    return np.concatenate([np.stack([line[:-1], line[1:]], axis=1) for line in lines])


def rotate_z_to(normal: Array) -> Quaternion:
    """Return a rotation from +z to the unit vector `normal` (3,)."""
    x, y, z = (float(n) for n in normal)
    if z < -0.999999:
        return (0.0, 1.0, 0.0, 0.0)
    w = sqrt(0.5 * (1.0 + z))
    return (w, -y / (2.0 * w), x / (2.0 * w), 0.0)


def rotate(q: Quaternion | Array, points: Array) -> Array:
    w, v = q[0], np.array(q[1:])
    cross = 2.0 * np.cross(v, points)
    return np.asarray(points + w * cross + np.cross(v, cross))


class Trace:
    """Latest part of a trace as coloured segments, as few as possible because each costs drawing time.

    min_distance  minimum distance between points; closer points are ignored
    """

    def __init__(self, min_distance: float, segments: int = 120) -> None:
        self._segments = np.zeros((segments, 2, 3))
        self._colours = np.zeros((segments, 2, 3), np.uint8)
        self._min_distance, self._count, self._last = min_distance, 0, None

    _last: Array | None

    @property
    def segments(self) -> Array:
        """Segments (n, 2, 3), padded with zero-length ones, so that the node grows only every GROWTH segments."""
        return self._segments[: self._round_up_count()]

    @property
    def colours(self) -> NDArray[np.uint8]:
        """Colours of the segments (n, 2, 3)."""
        return self._colours[: self._round_up_count()]

    def _round_up_count(self) -> int:
        return min(self._count + GROWTH - self._count % GROWTH, len(self._segments))

    def break_line(self) -> None:
        self._last, self._can_extend = None, False

    _can_extend = False

    def clear(self) -> None:
        self._segments[:], self._count = 0.0, 0
        self.break_line()

    def add(self, point: Array, colour: tuple[int, int, int]) -> bool:
        """Append a point (3,); return True if a segment was added or extended."""
        if self._last is None:
            self._last = point
            return False
        if np.linalg.norm(point - self._last) < self._min_distance:
            return False
        last_segment = (self._count - 1) % len(self._segments)
        is_same_colour = (self._colours[last_segment, 0] == colour).all()
        if self._can_extend and is_same_colour and self._is_extension(last_segment, point):
            self._segments[last_segment, 1] = point
        else:
            segment = self._count % len(self._segments)
            self._segments[segment], self._colours[segment] = (self._last, point), colour
            self._count += 1
        self._last, self._can_extend = point, True
        return True

    def _is_extension(self, last_segment: int, point: Array) -> bool:
        """Return whether the last segment can be extended to a point: forward, short, without visible deviation."""
        start, end = self._segments[last_segment]
        chord = point - start
        length = float(np.linalg.norm(chord))
        deviation = float(np.linalg.norm(np.cross(end - start, chord))) / max(length, self._min_distance)
        forward = float(np.dot(end - start, point - end)) >= 0.0
        longest, farthest = MAX_SEGMENT_STEPS * self._min_distance, MAX_DEVIATION_STEPS * self._min_distance
        return forward and length < longest and deviation < farthest
