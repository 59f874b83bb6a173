"""Generator of the shipped recordings: scripted motions of a fingertip over the plane z = 0, and of two on a box.

    python -m softfinger.tools.recordings OUTDIR

Each recording is a chain of minimum-jerk moves, so velocity and acceleration are continuous. It is sampled at 100 Hz
and rounded to fixed decimals, so that every machine writes the same bytes. The fingertip has a radius of 10 mm: its
centre touches the plane at z = 0.010 m and presses 1 mm at 0.009 m. All recordings start and end at rest in free space,
in one pose, and therefore loop without a return. A pinch has two recordings of equal length, one for each finger, which
press the sides of a box of 40 mm, x = -0.02 m and x = 0.02 m. So does a lift, with a box that rests on z = 0. Each
scene with moving bodies or an elastic object has one or two motions.
"""

from __future__ import annotations

import argparse
import io
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from softfinger.drivers import quaternions
from softfinger.drivers.poses import POSE_COLUMNS
from softfinger.tools import motions
from softfinger.tools.motions import FREE_HEIGHT_M, RATE_HZ, Move, Vector

OVER_THE_PLANE: Final = (0.0, 0.0, FREE_HEIGHT_M)
HALF_BOX_M: Final = 0.020
OFF_CENTRE_M: Final = 0.008
"""Distance of the grip from the centre of mass; the box hangs by the torsion of the contacts."""
HALF_SMALL_BOX_M: Final = 0.015
"""Half edge of a box of the scene `stack-boxes`."""
HALF_BALL_M: Final = 0.020
"""Radius of the ball of the scene `squeeze-a-ball`."""
INDEX_THINNER_M: Final = 0.002
"""Difference of the finger radii in the scene `pinch`; the thinner index finger starts closer by it."""


class Script(NamedTuple):
    """Upright start and end of a recording (m), and its moves."""

    start: Vector
    moves: Callable[[], list[Move]]


RECORDINGS: Final[dict[str, Script]] = {
    "press-roll-spin-drag": Script(OVER_THE_PLANE, motions.press_roll_spin_drag),
    "roll-follow": Script(OVER_THE_PLANE, motions.roll_follow),
    "tap": Script(OVER_THE_PLANE, motions.make_tap),
    "pinch-thumb": Script((-HALF_BOX_M - FREE_HEIGHT_M, 0.0, 0.0), lambda: motions.make_pinch(-1.0, 0.0)),
    "pinch-index": Script(
        (HALF_BOX_M + FREE_HEIGHT_M - INDEX_THINNER_M, 0.0, 0.0), lambda: motions.make_pinch(1.0, 0.004)
    ),
    "lift-thumb": Script((-HALF_BOX_M - FREE_HEIGHT_M, OFF_CENTRE_M, HALF_BOX_M), lambda: motions.lift(-1.0)),
    "lift-index": Script((HALF_BOX_M + FREE_HEIGHT_M, OFF_CENTRE_M, HALF_BOX_M), lambda: motions.lift(1.0)),
    "turn-a-knob": Script((0.0, 0.0, 0.015 + FREE_HEIGHT_M), motions.turn_a_knob),
    "open-a-drawer": Script((0.0, 0.039, 0.075), motions.open_a_drawer),
    "open-a-door": Script((0.04, -0.035, 0.0), motions.open_a_door),
    "press-a-button": Script((0.0, 0.0, 0.030), motions.press_a_button),
    "roll-a-pencil": Script((-0.25 * motions.PENCIL_STROKE_M, 0.0, 0.008 + FREE_HEIGHT_M), motions.roll_a_pencil),
    "plates": Script(
        (-0.5 * (motions.PLATES - 1) * motions.PLATE_PITCH_M, -0.0075, FREE_HEIGHT_M), motions.make_plates
    ),
    "press-a-pad": Script(OVER_THE_PLANE, motions.press_a_pad),
    "bend-a-strip": Script(OVER_THE_PLANE, motions.bend_a_strip),
    "squeeze-thumb": Script(
        (-HALF_BALL_M - FREE_HEIGHT_M, 0.0, 0.0), lambda: motions.make_squeeze(-1.0, presses=False)
    ),
    "squeeze-index": Script((HALF_BALL_M + FREE_HEIGHT_M, 0.0, 0.0), lambda: motions.make_squeeze(1.0, presses=True)),
    "push-a-ball": Script((-0.04, 0.0, 0.050), motions.push_a_ball),
    "stack-thumb": Script((-HALF_SMALL_BOX_M - FREE_HEIGHT_M, 0.0, HALF_SMALL_BOX_M), lambda: motions.stack(-1.0)),
    "stack-index": Script((HALF_SMALL_BOX_M + FREE_HEIGHT_M, 0.0, HALF_SMALL_BOX_M), lambda: motions.stack(1.0)),
}


def to_csv(script: Script) -> str:
    position, orientation, parts = np.array(script.start), np.array([1.0, 0.0, 0.0, 0.0]), []
    for move in script.moves():
        u = np.linspace(0.0, 1.0, round(move.seconds * RATE_HZ) + 1)[:, None]
        share = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
        positions = position + share * move.travel
        orientations = quaternions.multiply(quaternions.exp(share * move.turn), orientation)
        parts.append(np.hstack([positions, orientations])[:-1])
        position, orientation = positions[-1], orientations[-1]
    poses = np.vstack([*parts, [*position, *orientation]])
    # Rounding, then adding zero keeps "-0.0000000" out of the file.
    rounded = np.hstack([poses[:, :3].round(7), poses[:, 3:].round(8)]) + 0.0
    rows = np.column_stack([np.arange(len(poses)) / RATE_HZ, rounded])
    text = io.StringIO()
    np.savetxt(text, rows, ["%.2f", *["%.7f"] * 3, *["%.8f"] * 4], ",", header=",".join(POSE_COLUMNS), comments="")
    return text.getvalue()


def write(folder: Path) -> list[Path]:
    """Write every recording into `folder`, which is created if necessary."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / f"{name}.csv" for name in RECORDINGS]
    for path, script in zip(paths, RECORDINGS.values(), strict=True):
        path.write_text(to_csv(script), encoding="ascii", newline="\n")
    return paths


def main() -> None:
    parser = argparse.ArgumentParser(description="Write the shipped recordings.")
    parser.add_argument("outdir", type=Path, help="folder for the CSV files")
    for path in write(parser.parse_args().outdir):
        print(path)


if __name__ == "__main__":
    main()
