"""Generator of the shipped recordings: scripted motions of a fingertip over the plane z = 0, and of two on a box.

    python -m softfinger.tools.recordings OUTDIR

Each recording is a chain of minimum-jerk moves, so velocity and acceleration are continuous. It is sampled at 100 Hz
and rounded to fixed decimals, so that every machine writes the same bytes. The fingertip has a radius of 10 mm: its
centre touches the plane at z = 0.010 m and presses 1 mm at 0.009 m. All recordings start and end at rest in free space,
in one pose, and therefore loop without a return. A pinch has two recordings of equal length, one for each finger, which
press the sides of a box of 40 mm, x = -0.02 m and x = 0.02 m. So does a lift, with a box that rests on z = 0. Each
scene with moving bodies or an elastic object has one or two motions. The file is long because of this list of motions.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

RATE_HZ: Final = 100
RADIUS_M: Final = 0.010
ABOVE_M: Final = 0.020
PRESSED_M: Final = 0.009
HEADER: Final = "t,x,y,z,qw,qx,qy,qz"

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class Move(NamedTuple):
    """Minimum-jerk move: duration (s), travel (m, world), turn (rotation vector, rad, world axes)."""

    seconds: float
    travel: Vector = (0.0, 0.0, 0.0)
    turn: Vector = (0.0, 0.0, 0.0)


def hold(seconds: float) -> Move:
    return Move(seconds)


def press(seconds: float) -> Move:
    return Move(seconds, (0.0, 0.0, PRESSED_M - ABOVE_M))


def release(seconds: float) -> Move:
    return Move(seconds, (0.0, 0.0, ABOVE_M - PRESSED_M))


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
    return [
        hold(0.3),
        press(0.8),
        hold(0.2),
        *half,
        hold(0.1),
        *full,
        *spins,
        hold(0.1),
        *drags,
        hold(0.4),
        release(0.6),
        hold(0.3),
    ]


def roll_follow() -> list[Move]:
    """Return a roll of 1 rad that the hand follows fully, so that nothing may slide; it is reversed in the air."""
    return [
        hold(0.2),
        press(0.6),
        hold(0.2),
        roll(2.0, about_x=1.0),
        hold(0.2),
        release(0.6),
        roll(1.6, about_x=-1.0),
        hold(0.2),
    ]


def tap() -> list[Move]:
    """Return three taps of increasing speed."""
    moves = [hold(0.3)]
    for seconds in (0.30, 0.16, 0.08):
        moves += [press(seconds), release(seconds), hold(0.3)]
    return moves


def pinch(side: float, slide: float) -> list[Move]:
    """Return the motion of one finger of a pinch, from `side` -1 or 1 of the box.

    It presses, shears and twists the box back and forth within the sticking range, drags `slide` m along z and back
    (which slides at millimetres), and releases.
    """

    def inwards(seconds: float, way: float) -> Move:
        return Move(seconds, (-side * way, 0.0, 0.0))

    shear, twist = 0.0003, 0.05
    return [
        hold(0.3),
        inwards(0.6, ABOVE_M - PRESSED_M),
        hold(0.2),
        Move(0.3, (0.0, 0.0, shear)),
        Move(0.3, (0.0, 0.0, -shear)),
        Move(0.3, turn=(twist, 0.0, 0.0)),
        Move(0.3, turn=(-twist, 0.0, 0.0)),
        Move(0.5, (0.0, 0.0, slide)),
        Move(0.5, (0.0, 0.0, -slide)),
        hold(0.2),
        inwards(0.5, PRESSED_M - ABOVE_M),
        hold(0.3),
    ]


def lift(side: float) -> list[Move]:
    """Return the motion of one finger of a lift, from `side` -1 or 1 of the box.

    It presses, moves up by 100 mm, holds, moves down and releases.
    """

    def inwards(seconds: float, way: float) -> Move:
        return Move(seconds, (-side * way, 0.0, 0.0))

    press_m, height = ABOVE_M - RADIUS_M + SQUEEZE_M, 0.1
    return [
        hold(0.3),
        inwards(0.6, press_m),
        hold(0.2),
        Move(1.2, (0.0, 0.0, height)),
        hold(1.0),
        Move(1.2, (0.0, 0.0, -height)),
        hold(0.2),
        inwards(0.5, -press_m),
        hold(0.3),
    ]


def turn_a_knob() -> list[Move]:
    """Return a motion that presses the top of a knob, turns it by 1 rad, releases it, and turns back in the air.

    Each repetition turns the knob further.
    """
    down = (0.0, 0.0, PRESSED_M - ABOVE_M - 0.002)
    return [
        hold(0.3),
        Move(0.6, down),
        hold(0.2),
        spin(1.0, 1.0),
        hold(0.3),
        Move(0.4, _back(down)),
        spin(0.8, -1.0),
        hold(0.3),
    ]


def open_a_drawer() -> list[Move]:
    """Return a motion down behind the handle, 100 mm towards the hand, back on the front until it is shut, and up."""
    down, pull, clearance = (0.0, 0.0, -0.045), 0.1, 0.006
    return [
        hold(0.3),
        Move(0.6, down),
        hold(0.1),
        Move(1.4, (0.0, -pull, 0.0)),
        hold(0.4),
        Move(1.4, (0.0, pull + clearance, 0.0)),
        hold(0.2),
        Move(0.3, (0.0, -clearance, 0.0)),
        Move(0.6, _back(down)),
        hold(0.3),
    ]


def open_a_door() -> list[Move]:
    """Return a motion straight against the door, a wait, and the way back; the door follows."""
    push = (0.0, 0.085, 0.0)
    return [hold(0.3), Move(1.4, push), hold(0.6), Move(1.4, _back(push)), hold(1.0)]


def press_a_button() -> list[Move]:
    """Return a motion down to the cap, slowly through the click, a wait, and slowly back through the other click."""
    near, through = (0.0, 0.0, -0.0095), (0.0, 0.0, -0.005)
    return [
        hold(0.3),
        Move(0.4, near),
        Move(1.2, through),
        hold(0.3),
        Move(1.2, _back(through)),
        Move(0.4, _back(near)),
    ]


def roll_a_pencil() -> list[Move]:
    """Return a motion onto the pencil, 10 mm across it, and back."""
    down, across = (0.0, 0.0, PRESSED_M - ABOVE_M - 0.001), (PENCIL_WAY_M, 0.0, 0.0)
    return [
        hold(0.3),
        Move(0.6, down),
        hold(0.2),
        Move(1.0, across),
        hold(0.3),
        Move(1.0, _back(across)),
        hold(0.2),
        Move(0.6, _back(down)),
        hold(0.3),
    ]


def push_a_ball() -> list[Move]:
    """Return a motion behind the ball, up the side of its bowl, and away; the ball rolls back and swings."""
    down, along, away = (0.0, 0.0, -0.026), (0.04, 0.0, 0.0), (-0.005, 0.0, 0.026)
    return [
        hold(0.3),
        Move(0.5, down),
        Move(1.0, along),
        hold(0.2),
        Move(0.15, away),
        hold(4.0),
        Move(0.8, (-along[0] - away[0], 0.0, -down[2] - away[2])),
        hold(0.2),
    ]


def stack(side: float) -> list[Move]:
    """Return the motion of one of two fingers that put a box on a stack, from `side` -1 or 1 of it.

    It grips, lifts, carries, sets down and releases the box, then does the same in reverse.
    """
    take = (-side * (ABOVE_M - RADIUS_M + 0.004), 0.0, 0.0)
    lift_m, lower_m, carry = (0.0, 0.0, 0.064), (0.0, 0.0, -0.0045), (0.0, 0.06, 0.0)
    there = [
        Move(0.6, take),
        hold(0.2),
        Move(0.9, lift_m),
        Move(0.8, carry),
        hold(0.2),
        Move(0.4, lower_m),
        hold(0.2),
        Move(0.5, _back(take)),
    ]
    back = [move if move.travel == (0.0, 0.0, 0.0) else Move(move.seconds, _back(move.travel)) for move in there[::-1]]
    return [hold(0.3), *there, hold(1.0), *back, hold(0.3)]


def plates() -> list[Move]:
    """Return a motion over a row of plates: on each one down, a stroke and back, up; then back to the first."""
    down, stroke, on = (0.0, 0.0, PRESSED_M - 0.001 - ABOVE_M), (0.0, 0.015, 0.0), (PLATE_PITCH_M, 0.0, 0.0)
    one = [Move(0.5, down), hold(0.2), Move(0.5, stroke), Move(0.5, _back(stroke)), hold(0.1), Move(0.3, _back(down))]
    row = [*one, *((PLATES - 1) * [Move(0.4, on), *one])]
    return [hold(0.3), *row, Move(1.2, (-(PLATES - 1) * PLATE_PITCH_M, 0.0, 0.0)), hold(0.3)]


def press_a_pad() -> list[Move]:
    """Return a motion that presses a pad 5 mm deep, strokes 12 mm along y, which sticks and then slides, and back."""
    return _press_and_stroke(Move(0.8, (0.0, 0.0, RADIUS_M - 0.005 - ABOVE_M)), Move(0.8, (0.0, 0.012, 0.0)), 0.6)


def bend_a_strip() -> list[Move]:
    """Return a motion that bends a strip near its free end, moves 30 mm towards its clamp and back, and lets it go."""
    return _press_and_stroke(Move(1.0, (0.0, 0.0, RADIUS_M - 0.01 - ABOVE_M)), Move(1.0, (-0.03, 0.0, 0.0)), 0.5)


def _press_and_stroke(down: Move, stroke: Move, up_s: float) -> list[Move]:
    """Return a motion down, along a stroke and back, and up within `up_s`."""
    back, up = Move(stroke.seconds, _back(stroke.travel)), Move(up_s, _back(down.travel))
    return [hold(0.3), down, hold(0.3), stroke, back, hold(0.2), up, hold(0.3)]


def squeeze(side: float, presses: bool) -> list[Move]:
    """Return the motion of one of two fingers on a ball, from `side` -1 or 1 of it.

    It touches with 1 mm of depth; the finger that presses does so twice by another 4 mm, while the other waits.
    """
    touch, press_in = (-side * (ABOVE_M - PRESSED_M), 0.0, 0.0), (-side * 0.004, 0.0, 0.0)
    squeezes = [Move(0.7, press_in), hold(0.2), Move(0.7, _back(press_in)), hold(0.2)]
    middle = 2 * squeezes if presses else [hold(2 * sum(move.seconds for move in squeezes))]
    return [hold(0.3), Move(0.6, touch), hold(0.2), *middle, Move(0.5, _back(touch)), hold(0.3)]


def _back(travel: Vector) -> Vector:
    x, y, z = travel
    return (-x, -y, -z)


class Script(NamedTuple):
    """Upright start and end of a recording (m), and its moves."""

    start: Vector
    moves: Callable[[], list[Move]]


OVER_THE_PLANE: Final = (0.0, 0.0, ABOVE_M)
HALF_BOX_M: Final = 0.020
SQUEEZE_M: Final = 0.006
"""Intended depth of the hands of a lift; a hand as stiff as the box presses half of it, with 3 N."""
OFF_CENTRE_M: Final = 0.008
"""Distance of the grip from the centre of mass; the box hangs by the torsion of the contacts."""
PENCIL_WAY_M: Final = 0.01
PLATES: Final = 7
PLATE_PITCH_M: Final = 0.02
"""Number and pitch of the plates in the scene `plates`."""
HALF_SMALL_BOX_M: Final = 0.015
"""Half edge of a box of the scene `stack-boxes`."""
HALF_BALL_M: Final = 0.020
"""Radius of the ball of the scene `squeeze-a-ball`."""
INDEX_THINNER_M: Final = 0.002
"""Difference of the finger radii in the scene `pinch`; the thinner index finger starts closer by it."""

RECORDINGS: Final[dict[str, Script]] = {
    "press-roll-spin-drag": Script(OVER_THE_PLANE, press_roll_spin_drag),
    "roll-follow": Script(OVER_THE_PLANE, roll_follow),
    "tap": Script(OVER_THE_PLANE, tap),
    "pinch-thumb": Script((-HALF_BOX_M - ABOVE_M, 0.0, 0.0), lambda: pinch(-1.0, 0.0)),
    "pinch-index": Script((HALF_BOX_M + ABOVE_M - INDEX_THINNER_M, 0.0, 0.0), lambda: pinch(1.0, 0.004)),
    "lift-thumb": Script((-HALF_BOX_M - ABOVE_M, OFF_CENTRE_M, HALF_BOX_M), lambda: lift(-1.0)),
    "lift-index": Script((HALF_BOX_M + ABOVE_M, OFF_CENTRE_M, HALF_BOX_M), lambda: lift(1.0)),
    "turn-a-knob": Script((0.0, 0.0, 0.015 + ABOVE_M), turn_a_knob),
    "open-a-drawer": Script((0.0, 0.039, 0.075), open_a_drawer),
    "open-a-door": Script((0.04, -0.035, 0.0), open_a_door),
    "press-a-button": Script((0.0, 0.0, 0.030), press_a_button),
    "roll-a-pencil": Script((-0.25 * PENCIL_WAY_M, 0.0, 0.008 + ABOVE_M), roll_a_pencil),
    "plates": Script((-0.5 * (PLATES - 1) * PLATE_PITCH_M, -0.0075, ABOVE_M), plates),
    "press-a-pad": Script(OVER_THE_PLANE, press_a_pad),
    "bend-a-strip": Script(OVER_THE_PLANE, bend_a_strip),
    "squeeze-thumb": Script((-HALF_BALL_M - ABOVE_M, 0.0, 0.0), lambda: squeeze(-1.0, presses=False)),
    "squeeze-index": Script((HALF_BALL_M + ABOVE_M, 0.0, 0.0), lambda: squeeze(1.0, presses=True)),
    "push-a-ball": Script((-0.04, 0.0, 0.050), push_a_ball),
    "stack-thumb": Script((-HALF_SMALL_BOX_M - ABOVE_M, 0.0, HALF_SMALL_BOX_M), lambda: stack(-1.0)),
    "stack-index": Script((HALF_SMALL_BOX_M + ABOVE_M, 0.0, HALF_SMALL_BOX_M), lambda: stack(1.0)),
}


def to_csv(script: Script) -> str:
    """Return the poses of a script as CSV text."""
    position, moves = script.start, script.moves()
    orientation: Quaternion = (1.0, 0.0, 0.0, 0.0)
    lines, row = [HEADER], 0
    for move in moves:
        count = round(move.seconds * RATE_HZ)
        for k in range(count):
            lines.append(_line(row, *_at(position, orientation, move, k / count)))
            row += 1
        position, orientation = _at(position, orientation, move, 1.0)
    lines.append(_line(row, position, orientation))
    return "\n".join(lines) + "\n"


def write(folder: Path) -> list[Path]:
    """Write every recording into `folder`, which is created if necessary."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.csv" for name in RECORDINGS]
    for path, script in zip(paths, RECORDINGS.values(), strict=True):
        path.write_text(to_csv(script), encoding="ascii", newline="\n")
    return paths


def _at(position: Vector, orientation: Quaternion, move: Move, u: float) -> tuple[Vector, Quaternion]:
    done = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    x, y, z = (p + done * d for p, d in zip(position, move.travel, strict=True))
    return (x, y, z), _turned(orientation, move.turn, done)


def _turned(q: Quaternion, turn: Vector, part: float) -> Quaternion:
    angle = math.hypot(*turn)
    if angle == 0.0:
        return q
    aw, scale = math.cos(0.5 * part * angle), math.sin(0.5 * part * angle) / angle
    ax, ay, az = (scale * component for component in turn)
    bw, bx, by, bz = q
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def _line(row: int, position: Vector, orientation: Quaternion) -> str:
    # rounding then adding zero keeps "-0.0000000" out of the file
    cells = [f"{round(p, 7) + 0.0:.7f}" for p in position] + [f"{round(q, 8) + 0.0:.8f}" for q in orientation]
    return ",".join([f"{row / RATE_HZ:.2f}", *cells])


def main() -> None:
    parser = argparse.ArgumentParser(description="Write the shipped recordings.")
    parser.add_argument("outdir", type=Path, help="folder for the CSV files")
    for path in write(parser.parse_args().outdir):
        print(path)


if __name__ == "__main__":
    main()
