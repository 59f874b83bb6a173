"""Gestures of simulated hands: press, roll, slide, spin and lift, as targets of the fingers per frame.

A gesture is a generator: it yields the target of each finger by name and receives the time (s) since the last frame.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from math import cos, pi, radians
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.server.viewer.inputs import Nudge
from softfinger.server.viewer.nodes.below import UP
from softfinger.server.viewer.nodes.glyphs import rotated
from softfinger.server.viewer.target import Target, nudged

Array = NDArray[np.float64]
Goals = Mapping[str, Target]
Gesture = Generator[Goals, float, None]

HOVER_M: Final = 0.008
"""Gap between fingertip and object before a touch."""
SPEED: Final = 0.02
"""m/s during an approach."""
LOOK_S: Final = 0.05
"""Maximum time step of an approach, which must check the force between steps."""
CARRIES: Final = 0.08
"""m/s in free space."""
DEEPEST_M: Final = 0.012
"""Maximum depth of the target below a surface."""
PRESS_N: Final = 1.0
GRIP_N: Final = 2.5
"""Twice the force that holds 100 g with friction 0.2."""
STAYS_S: Final = 0.8
LIFT_M: Final = 0.05
LIFTS: Final = 0.04
"""m/s of a gripped object."""
ROLL_M: Final = 0.012
SLIDE_M: Final = 0.025
SPIN_RAD: Final = radians(70.0)
STROKE_S: Final = 1.5


class Stage(NamedTuple):
    """Inputs of a gesture.

    target  of a finger
    force   normal force of a finger, N
    radius  of a finger, m
    height  height (m) of the object straight below a point (3,); None if there is none
    """

    target: Callable[[str], Target]
    force: Callable[[str], float]
    radius: Callable[[str], float]
    height: Callable[[Array], float | None]


class Box(NamedTuple):
    """Box to lift: current centre `middle()` (3,) m, half width along x (m), and a function that resets its pose."""

    middle: Callable[[], Array]
    half_m: float
    put_back: Callable[[], None]


def glide(starts: Goals, ends: Goals, seconds: float) -> Gesture:
    """Move in a straight line with zero speed at both ends, at the orientation of the end."""
    passed = 0.0
    while passed < seconds:
        share = 0.5 - 0.5 * cos(pi * passed / seconds)
        passed += yield {name: _between(starts[name], end, share) for name, end in ends.items()}
    yield ends


def carry(stage: Stage, places: Mapping[str, Array], speed: float = CARRIES) -> Gesture:
    """Move fingers to positions (3,) m at constant orientation; all arrive at the same time."""
    starts = {name: stage.target(name) for name in places}
    far = max(float(np.linalg.norm(place - starts[name].position)) for name, place in places.items())
    ends = {name: Target(place, starts[name].orientation) for name, place in places.items()}
    yield from glide(starts, ends, max(far * pi / 2.0 / speed, 0.05))


def close_in(stage: Stage, ways: Mapping[str, Array], force_n: float) -> Gesture:
    """Move along unit vectors (3,) until each finger feels `force_n` or reaches its maximum depth."""
    starts = {name: stage.target(name) for name in ways}
    gone = dict.fromkeys(ways, 0.0)
    going = set(ways)
    while going:
        dt = yield {
            name: Target(starts[name].position + gone[name] * ways[name], starts[name].orientation) for name in ways
        }
        for name in list(going):
            if stage.force(name) >= force_n or gone[name] >= HOVER_M + DEEPEST_M:
                going.discard(name)
            else:
                gone[name] += SPEED * min(dt, LOOK_S)


def wait(goals: Goals, seconds: float) -> Gesture:
    """Stay at the targets."""
    yield from glide(goals, goals, seconds)


def press(stage: Stage, finger: str) -> Gesture:
    """Press the object below, and lift off."""
    yield from _touch(stage, finger)
    yield from wait({finger: stage.target(finger)}, STAYS_S)
    yield from _leave(stage, finger)


def roll(stage: Stage, finger: str) -> Gesture:
    """Press, roll along x like a ball and back, and lift off."""
    yield from _stroke(stage, finger, Nudge(roll_x=ROLL_M))


def slide(stage: Stage, finger: str) -> Gesture:
    """Press, slide along x and back at constant orientation, and lift off."""
    yield from _stroke(stage, finger, Nudge(x=SLIDE_M))


def spin(stage: Stage, finger: str) -> Gesture:
    """Press, rotate about the vertical axis and back, and lift off."""
    yield from _stroke(stage, finger, Nudge(spin=SPIN_RAD))


ONE_FINGER: Final = {"press": press, "roll": roll, "slide": slide, "spin": spin}
"""Gestures of one finger on the object below it."""


def lift(stage: Stage, left: str, right: str, box: Box) -> Gesture:
    """Open, grip the box from both sides, lift it, hold it, put it down, and open."""
    apart = {name: box.half_m + stage.radius(name) + HOVER_M for name in (left, right)}
    sides = {left: np.array([-1.0, 0.0, 0.0]), right: np.array([1.0, 0.0, 0.0])}

    def beside(name: str) -> Array:
        return box.middle() + apart[name] * sides[name]

    out = {}
    for name, way in sides.items():
        out[name] = stage.target(name).position.copy()
        out[name][0] = way[0] * max(way[0] * out[name][0], way[0] * beside(name)[0])
    yield from carry(stage, out)
    box.put_back()
    yield from wait({name: stage.target(name) for name in sides}, STAYS_S)
    yield from carry(stage, {name: beside(name) for name in sides})
    yield from close_in(stage, {name: -way for name, way in sides.items()}, GRIP_N)
    held = {name: stage.target(name).position for name in sides}
    yield from carry(stage, {name: place + LIFT_M * UP for name, place in held.items()}, LIFTS)
    yield from wait({name: stage.target(name) for name in sides}, STAYS_S)
    yield from carry(stage, held, LIFTS)
    yield from carry(stage, {name: beside(name) for name in sides}, SPEED)


def _between(start: Target, end: Target, share: float) -> Target:
    return Target(start.position + share * (end.position - start.position), end.orientation)


def _touch(stage: Stage, finger: str) -> Gesture:
    """Approach the object below from above until the finger presses it."""
    here = stage.target(finger).position
    height = stage.height(here)
    assert height is not None, "it was looked for before"
    above = np.array([here[0], here[1], height + stage.radius(finger) + HOVER_M])
    yield from carry(stage, {finger: above})
    yield from close_in(stage, {finger: -UP}, PRESS_N)


def _leave(stage: Stage, finger: str) -> Gesture:
    yield from carry(stage, {finger: stage.target(finger).position + 2.0 * HOVER_M * UP})


def _stroke(stage: Stage, finger: str, way: Nudge) -> Gesture:
    """Touch, move by `way` and back at the same depth, and lift off; reversed at x > 0, to stay near the origin."""
    yield from _touch(stage, finger)
    start = stage.target(finger)
    ground = stage.height(start.position)
    sign = -1.0 if start.position[0] > 0.0 else 1.0
    passed = 0.0
    while passed < 2.0 * STROKE_S:
        share = 0.5 - 0.5 * cos(pi * passed / STROKE_S)
        there = nudged(start, way.times(sign * share), stage.radius(finger))
        below = stage.height(there.position)
        rises = 0.0 if below is None or ground is None else below - ground
        passed += yield {finger: Target(there.position + rises * UP, there.orientation)}
    yield {finger: start}
    yield from _leave(stage, finger)


def half_width(size_m: tuple[float, float, float], turn: tuple[float, float, float, float]) -> float:
    """Return the half width of a rotated box along x, m."""
    return 0.5 * float(np.abs(rotated(turn, np.diag(size_m))[:, 0]).sum())
