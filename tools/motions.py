"""Motions of the shipped recordings: a list of moves for each finger, of equal total length."""

from __future__ import annotations

import math
from typing import Final, NamedTuple

RATE_HZ: Final = 100
RADIUS_M: Final = 0.010
FREE_HEIGHT_M: Final = 0.020
PRESSED_HEIGHT_M: Final = 0.009
"""Radius of the fingertip, and heights of its centre in free space and on the plane."""

Vector = tuple[float, float, float]


class Move(NamedTuple):
    """Minimum-jerk move: duration (s), travel (m, world), turn (rotation vector, rad, world axes)."""

    seconds: float
    travel: Vector = (0.0, 0.0, 0.0)
    turn: Vector = (0.0, 0.0, 0.0)


def hold(seconds: float) -> Move:
    return Move(seconds)


def press(seconds: float) -> Move:
    return Move(seconds, (0.0, 0.0, PRESSED_HEIGHT_M - FREE_HEIGHT_M))


def release(seconds: float) -> Move:
    return Move(seconds, (0.0, 0.0, FREE_HEIGHT_M - PRESSED_HEIGHT_M))


def roll(seconds: float, about_x: float = 0.0, about_y: float = 0.0, followed: float = 1.0) -> Move:
    """Roll by radians about a world axis; the hand follows the fraction `followed` of the path of the contact."""
    # without slip the centre travels r (turn x n), n = +z
    return Move(seconds, (followed * RADIUS_M * about_y, -followed * RADIUS_M * about_x, 0.0), (about_x, about_y, 0.0))


def spin(seconds: float, angle: float) -> Move:
    return Move(seconds, turn=(0.0, 0.0, angle))


def drag(distance: float, speed: float) -> Move:
    """Slide along x, at most at `speed` (m/s)."""
    seconds = 1.875 * abs(distance) / speed  # peak over mean velocity of a minimum-jerk move
    return Move(math.ceil(seconds * RATE_HZ) / RATE_HZ, (distance, 0.0, 0.0))


def mirror(travel: Vector) -> Vector:
    x, y, z = travel
    return (-x, -y, -z)


SQUEEZE_M: Final = 0.006
"""Intended depth of the hands of a lift; a hand as stiff as the box presses half of it, with 3 N."""
PENCIL_STROKE_M: Final = 0.01
PLATES: Final = 7
PLATE_PITCH_M: Final = 0.02
"""Number and pitch of the plates in the scene `make_plates`."""


def press_roll_spin_drag() -> list[Move]:
    """Return all kinds of motion.

    They are half-followed rolls (which must stick), fully followed rolls, spins past the torsional limit, a drag until
    it slides, its reversal, a stop and a release.
    """
    small, large = 0.04, 0.6
    half = [roll(0.4, about_x=small, followed=0.5), roll(0.4, about_x=-small, followed=0.5)]
    half += [roll(0.4, about_y=small, followed=0.5), roll(0.4, about_y=-small, followed=0.5)]
    full = [roll(0.9, about_x=large), roll(0.9, about_x=-large), roll(0.9, about_y=large), roll(0.9, about_y=-large)]
    spins = [spin(0.4, 0.15), spin(0.8, -0.30), spin(0.4, 0.15)]
    drags = [drag(0.020, 0.040), drag(-0.020, 0.040)]
    return _touch(press(0.8), [*half, hold(0.1), *full, *spins, hold(0.1), *drags, hold(0.2)], 0.6)


def _touch(onto: Move, middle: list[Move], back_s: float, settle_s: float = 0.2) -> list[Move]:
    """Return a motion onto a surface, the moves there, and the way back within `back_s`."""
    back = Move(back_s, mirror(onto.travel))
    return [hold(0.3), onto, hold(settle_s), *middle, hold(0.2), back, hold(0.3)]


def _append_return(move: Move) -> list[Move]:
    return [move, Move(move.seconds, mirror(move.travel))]


def roll_follow() -> list[Move]:
    """Return a roll of 1 rad that the hand follows fully, so that nothing may slide; it is reversed in the air."""
    touching = [press(0.6), hold(0.2), roll(2.0, about_x=1.0), hold(0.2), release(0.6)]
    return [hold(0.2), *touching, roll(1.6, about_x=-1.0), hold(0.2)]


def make_tap() -> list[Move]:
    """Return three taps of increasing speed."""
    moves = [hold(0.3)]
    for seconds in (0.30, 0.16, 0.08):
        moves += [press(seconds), release(seconds), hold(0.3)]
    return moves


def make_pinch(side: float, slide: float) -> list[Move]:
    """Return the motion of one finger of a pinch, from `side` -1 or 1 of the box.

    It presses, shears and twists the box back and forth within the sticking range, drags `slide` m along z and back
    (which slides at millimetres), and releases.
    """
    twists = [Move(0.3, turn=(angle, 0.0, 0.0)) for angle in (0.05, -0.05)]
    middle = [*_append_return(Move(0.3, (0.0, 0.0, 0.0003))), *twists, *_append_return(Move(0.5, (0.0, 0.0, slide)))]
    return _touch(_press_inwards(side, 0.6, FREE_HEIGHT_M - PRESSED_HEIGHT_M), middle, 0.5)


def lift(side: float) -> list[Move]:
    """Return the motion of one finger of a lift, from `side` -1 or 1 of the box.

    It presses, moves up by 100 mm, holds, moves down and releases.
    """
    up, down = _append_return(Move(1.2, (0.0, 0.0, 0.1)))
    return _touch(_press_inwards(side, 0.6, FREE_HEIGHT_M - RADIUS_M + SQUEEZE_M), [up, hold(1.0), down], 0.5)


def _press_inwards(side: float, seconds: float, distance: float) -> Move:
    return Move(seconds, (-side * distance, 0.0, 0.0))


def turn_a_knob() -> list[Move]:
    """Return a motion that presses the top of a knob, turns it by 1 rad, releases it, and turns back in the air.

    Each repetition turns the knob further.
    """
    down = (0.0, 0.0, PRESSED_HEIGHT_M - FREE_HEIGHT_M - 0.002)
    up = mirror(down)
    return [hold(0.3), Move(0.6, down), hold(0.2), spin(1.0, 1.0), hold(0.3), Move(0.4, up), spin(0.8, -1.0), hold(0.3)]


def open_a_drawer() -> list[Move]:
    """Return a motion down behind the handle, 100 mm towards the hand, back on the front until it is shut, and up."""
    (down, up), pull, clearance = _append_return(Move(0.6, (0.0, 0.0, -0.045))), 0.1, 0.006
    shut = [Move(1.4, (0.0, pull + clearance, 0.0)), hold(0.2), Move(0.3, (0.0, -clearance, 0.0))]
    return [hold(0.3), down, hold(0.1), Move(1.4, (0.0, -pull, 0.0)), hold(0.4), *shut, up, hold(0.3)]


def open_a_door() -> list[Move]:
    push, back = _append_return(Move(1.4, (0.0, 0.085, 0.0)))
    return [hold(0.3), push, hold(0.6), back, hold(1.0)]


def press_a_button() -> list[Move]:
    """Return a motion down to the cap, slowly through the click, a wait, and slowly back through the other click."""
    near, away = _append_return(Move(0.4, (0.0, 0.0, -0.0095)))
    through, back = _append_return(Move(1.2, (0.0, 0.0, -0.005)))
    return [hold(0.3), near, through, hold(0.3), back, away]


def roll_a_pencil() -> list[Move]:
    """Return a motion onto the pencil, 10 mm across it, and back."""
    across, back = _append_return(Move(1.0, (PENCIL_STROKE_M, 0.0, 0.0)))
    return _touch(Move(0.6, (0.0, 0.0, PRESSED_HEIGHT_M - FREE_HEIGHT_M - 0.001)), [across, hold(0.3), back], 0.6)


def push_a_ball() -> list[Move]:
    """Return a motion behind the ball, up the side of its bowl, and away; the ball rolls back and swings."""
    down, along, away = (0.0, 0.0, -0.026), (0.04, 0.0, 0.0), (-0.005, 0.0, 0.026)
    back = Move(0.8, (-along[0] - away[0], 0.0, -down[2] - away[2]))
    return [hold(0.3), Move(0.5, down), Move(1.0, along), hold(0.2), Move(0.15, away), hold(4.0), back, hold(0.2)]


def stack(side: float) -> list[Move]:
    """Return the motion of one of two fingers that put a box on a stack, from `side` -1 or 1 of it.

    It grips, lifts, carries, sets down and releases the box, then does the same in reverse.
    """
    take_m = FREE_HEIGHT_M - RADIUS_M + 0.004
    carry = [Move(0.9, (0.0, 0.0, 0.064)), Move(0.8, (0.0, 0.06, 0.0)), hold(0.2), Move(0.4, (0.0, 0.0, -0.0045))]
    forward = [_press_inwards(side, 0.6, take_m), hold(0.2), *carry, hold(0.2), _press_inwards(side, 0.5, -take_m)]
    back = [
        move if move.travel == (0.0, 0.0, 0.0) else Move(move.seconds, mirror(move.travel)) for move in forward[::-1]
    ]
    return [hold(0.3), *forward, hold(1.0), *back, hold(0.3)]


def make_plates() -> list[Move]:
    """Return a motion over a row of plates: on each one down, a stroke and back, up; then back to the first."""
    down, stroke, on = (
        (0.0, 0.0, PRESSED_HEIGHT_M - 0.001 - FREE_HEIGHT_M),
        (0.0, 0.015, 0.0),
        (PLATE_PITCH_M, 0.0, 0.0),
    )
    samples = [Move(0.5, down), hold(0.2), *_append_return(Move(0.5, stroke)), hold(0.1), Move(0.3, mirror(down))]
    row = [*samples, *((PLATES - 1) * [Move(0.4, on), *samples])]
    return [hold(0.3), *row, Move(1.2, (-(PLATES - 1) * PLATE_PITCH_M, 0.0, 0.0)), hold(0.3)]


def press_a_pad() -> list[Move]:
    """Return a motion that presses a pad 5 mm deep, strokes 12 mm along y, which sticks and then slides, and back."""
    strokes = _append_return(Move(0.8, (0.0, 0.012, 0.0)))
    return _touch(Move(0.8, (0.0, 0.0, RADIUS_M - 0.005 - FREE_HEIGHT_M)), strokes, 0.6, settle_s=0.3)


def bend_a_strip() -> list[Move]:
    """Return a motion that bends a strip near its free end, moves 30 mm towards its clamp and back, and lets it go."""
    strokes = _append_return(Move(1.0, (-0.03, 0.0, 0.0)))
    return _touch(Move(1.0, (0.0, 0.0, RADIUS_M - 0.01 - FREE_HEIGHT_M)), strokes, 0.5, settle_s=0.3)


def make_squeeze(side: float, presses: bool) -> list[Move]:
    """Return the motion of one of two fingers on a ball, from `side` -1 or 1 of it.

    It touches with 1 mm of depth; the finger that presses does so twice by another 4 mm, while the other waits.
    """
    press_in, let_out = _append_return(_press_inwards(side, 0.7, 0.004))
    squeezes = [press_in, hold(0.2), let_out, hold(0.2), press_in, hold(0.2), let_out]
    middle = squeezes if presses else [hold(sum(move.seconds for move in squeezes))]
    return _touch(_press_inwards(side, 0.6, FREE_HEIGHT_M - PRESSED_HEIGHT_M), middle, 0.5)
