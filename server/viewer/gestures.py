"""Gestures of simulated hands: press, roll, slide, spin and lift, as targets of the fingers per frame.

A gesture is a generator: it yields the target of each finger by name and receives the time (s) since the last frame.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from math import cos, pi, radians
from typing import Final, NamedTuple

import numpy as np

from softfinger.config.arrays import Array
from softfinger.server.viewer.inputs import Nudge
from softfinger.server.viewer.nodes.below import UP
from softfinger.server.viewer.nodes.glyphs import rotate
from softfinger.server.viewer.target import Target, nudge_target

Goals = Mapping[str, Target]
Gesture = Generator[Goals, float, None]

HOVER_M: Final = 0.008
"""Gap between fingertip and object before a touch."""
APPROACH_SPEED_M_PER_S: Final = 0.02
MAX_STEP_S: Final = 0.05
"""Maximum time step of an approach, which must check the force between steps."""
CARRY_SPEED_M_PER_S: Final = 0.08
"""m/s in free space."""
MAX_DEPTH_M: Final = 0.012
"""Maximum depth of the target below a surface."""
PRESS_N: Final = 1.0
GRIP_N: Final = 2.5
"""Twice the force that holds 100 g with friction 0.2."""
HOLD_S: Final = 0.8
LIFT_M: Final = 0.05
LIFT_SPEED_M_PER_S: Final = 0.04
"""m/s of a gripped object."""
ROLL_M: Final = 0.012
SLIDE_M: Final = 0.025
SPIN_RAD: Final = radians(70.0)
STROKE_S: Final = 1.5


class Stage(NamedTuple):
    """Inputs of a gesture.

    target  of a finger
    proxy   position (3,) m of a finger's proxy, outside all objects even if the target is inside one
    force   normal force of a finger, N
    height  height (m) of the object straight below a point (3,); None if there is none
    """

    target: Callable[[str], Target]
    proxy: Callable[[str], Array]
    force: Callable[[str], float]
    radius: Callable[[str], float]
    height: Callable[[Array], float | None]


class LiftedBox(NamedTuple):
    """Box to lift: current centre `centre()` (3,) m, half width along x (m), and a function that resets its pose."""

    centre: Callable[[], Array]
    half_m: float
    reset_world: Callable[[], None]


def glide(starts: Goals, ends: Goals, seconds: float) -> Gesture:
    """Move in a straight line with zero speed at both ends, at the orientation of the end."""
    elapsed_s = 0.0
    while elapsed_s < seconds:
        share = 0.5 - 0.5 * cos(pi * elapsed_s / seconds)
        elapsed_s += yield {name: _interpolate(starts[name], end, share) for name, end in ends.items()}
    yield ends


def carry(stage: Stage, positions: Mapping[str, Array], speed: float = CARRY_SPEED_M_PER_S) -> Gesture:
    """Move fingers to positions (3,) m at constant orientation; all arrive at the same time."""
    starts = {name: stage.target(name) for name in positions}
    distance = max(float(np.linalg.norm(position - starts[name].position)) for name, position in positions.items())
    ends = {name: Target(position, starts[name].orientation) for name, position in positions.items()}
    yield from glide(starts, ends, max(distance * pi / 2.0 / speed, 0.05))


def approach(stage: Stage, directions: Mapping[str, Array], force_n: float) -> Gesture:
    """Move along unit vectors (3,) until each finger feels `force_n` or reaches its maximum depth."""
    starts = {name: stage.target(name) for name in directions}
    depths = dict.fromkeys(directions, 0.0)
    active = set(directions)
    while active:
        dt = yield {
            name: Target(starts[name].position + depths[name] * directions[name], starts[name].orientation)
            for name in directions
        }
        for name in list(active):
            if stage.force(name) >= force_n or depths[name] >= HOVER_M + MAX_DEPTH_M:
                active.discard(name)
            else:
                depths[name] += APPROACH_SPEED_M_PER_S * min(dt, MAX_STEP_S)


def wait(goals: Goals, seconds: float) -> Gesture:
    yield from glide(goals, goals, seconds)


def press(stage: Stage, finger: str) -> Gesture:
    """Press the object below, and lift off."""
    yield from _touch(stage, finger)
    yield from wait({finger: stage.target(finger)}, HOLD_S)
    yield from _lift_off(stage, finger)


def roll(stage: Stage, finger: str) -> Gesture:
    """Press, roll along x like a ball and back, and lift off."""
    yield from _make_stroke(stage, finger, Nudge(roll_x=ROLL_M))


def slide(stage: Stage, finger: str) -> Gesture:
    """Press, slide along x and back at constant orientation, and lift off."""
    yield from _make_stroke(stage, finger, Nudge(x=SLIDE_M))


def spin(stage: Stage, finger: str) -> Gesture:
    """Press, rotate about the vertical axis and back, and lift off."""
    yield from _make_stroke(stage, finger, Nudge(spin=SPIN_RAD))


ONE_FINGER: Final = {"press": press, "roll": roll, "slide": slide, "spin": spin}
"""Gestures of one finger on the object below it."""


def lift(stage: Stage, left: str, right: str, box: LiftedBox) -> Gesture:
    """Open, grip the box from both sides, lift it, hold it, put it down, and open."""
    distances = {name: box.half_m + stage.radius(name) + HOVER_M for name in (left, right)}
    sides = {left: np.array([-1.0, 0.0, 0.0]), right: np.array([1.0, 0.0, 0.0])}

    def side_position(name: str) -> Array:
        return box.centre() + distances[name] * sides[name]

    open_positions = {}
    for name, direction in sides.items():
        open_positions[name] = stage.target(name).position.copy()
        open_positions[name][0] = direction[0] * max(
            direction[0] * open_positions[name][0], direction[0] * side_position(name)[0]
        )
    yield from carry(stage, open_positions)
    box.reset_world()
    yield from wait({name: stage.target(name) for name in sides}, HOLD_S)
    yield from carry(stage, {name: side_position(name) for name in sides})
    yield from approach(stage, {name: -direction for name, direction in sides.items()}, GRIP_N)
    grip_positions = {name: stage.target(name).position for name in sides}
    yield from carry(
        stage, {name: position + LIFT_M * UP for name, position in grip_positions.items()}, LIFT_SPEED_M_PER_S
    )
    yield from wait({name: stage.target(name) for name in sides}, HOLD_S)
    yield from carry(stage, grip_positions, LIFT_SPEED_M_PER_S)
    yield from carry(stage, {name: side_position(name) for name in sides}, APPROACH_SPEED_M_PER_S)


def _interpolate(start: Target, end: Target, share: float) -> Target:
    return Target(start.position + share * (end.position - start.position), end.orientation)


def _touch(stage: Stage, finger: str) -> Gesture:
    """Approach the object below from above until the finger presses it."""
    position = stage.proxy(finger)
    height = stage.height(position)
    assert height is not None, "it was checked before"
    above = np.array([position[0], position[1], height + stage.radius(finger) + HOVER_M])
    yield from carry(stage, {finger: above})
    yield from approach(stage, {finger: -UP}, PRESS_N)


def _lift_off(stage: Stage, finger: str) -> Gesture:
    yield from carry(stage, {finger: stage.target(finger).position + 2.0 * HOVER_M * UP})


def _make_stroke(stage: Stage, finger: str, stroke: Nudge) -> Gesture:
    """Touch, move by `stroke` and back at the same depth, and lift off; reversed at x > 0, to stay near the origin."""
    yield from _touch(stage, finger)
    start = stage.target(finger)
    ground = stage.height(start.position)
    sign = -1.0 if start.position[0] > 0.0 else 1.0
    elapsed_s = 0.0
    while elapsed_s < 2.0 * STROKE_S:
        share = 0.5 - 0.5 * cos(pi * elapsed_s / STROKE_S)
        target = nudge_target(start, stroke.times(sign * share), stage.radius(finger))
        below = stage.height(target.position)
        rise = 0.0 if below is None or ground is None else below - ground
        elapsed_s += yield {finger: Target(target.position + rise * UP, target.orientation)}
    yield {finger: start}
    yield from _lift_off(stage, finger)


def compute_half_width(size_m: tuple[float, float, float], orientation: tuple[float, float, float, float]) -> float:
    """Return the half width of a rotated box along x, m."""
    return 0.5 * float(np.abs(rotate(orientation, np.diag(size_m))[:, 0]).sum())
