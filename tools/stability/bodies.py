"""Stability of bodies that fingers drag, balance and hold, from light to heavy and from soft to hard.

    drag     one finger presses a box onto a floor, and drags it
    balance  one finger carries a plate, and lifts it
    hold     two fingers lift a box

The hands follow a path, as stiff as hands can be. Each case has two runs. In the first, the hands move to the body,
move it, and return to their start: a closed cycle. In the second, they stop at the body, it gets a velocity knock, and
the remaining speed a second later shows whether it rings. An unused finger is far away, so that all cases are one type
of scene, with kernels that are compiled once.
"""

from __future__ import annotations

import tempfile
from itertools import pairwise, product
from math import sqrt
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from softfinger.config.errors import SafetyStop
from softfinger.proxy.engine import Engine
from softfinger.proxy.record import FREE, SLIDING
from softfinger.server.progress import map_with_progress
from softfinger.tools.measure import Array

DT: Final = 1e-3
G: Final = 9.81
FINGERS: Final = ("thumb", "index")
RADIUS_M: Final = 0.01
HALF_M: Final = 0.02
"""Half edge of the box of 40 mm; the plate is as wide, and thinner."""
PLATE_HALF_M: Final = 0.003
"""Its centre of mass is lower than the fingertip's radius, so it remains on the finger."""
FRICTION: Final = 0.8
FLOOR_FRICTION: Final = 0.1
TORSION: Final = 0.05
CASES: Final = ("drag", "balance", "hold")
MASSES: Final = (0.001, 0.01, 0.03, 0.1, 0.3, 1.0)
STIFFNESSES: Final = (200.0, 500.0, 1000.0, 2000.0, 3000.0)
LIGHT_KG: Final = 0.01
LIGHT_SUBSTEPS: Final = 4
"""Substeps for bodies lighter than that."""
KNOCK: Final = (0.01, 0.01, 0.01, 0.3, 0.3, 0.3)
"""Velocity of a knock, m/s and rad/s."""
PAUSE_S: Final = 0.2
"""Pause of the hands in the middle of a cycle, and before the knock."""
WATCH_S: Final = 1.0
QUARTER: Final = round(0.25 * WATCH_S / DT)
MOVES_M: Final = {"drag": 0.01, "balance": 0.02, "hold": 0.02}
"""Distance by which the hands move a body."""
LEG: Final = round(0.3 / DT)
"""Ticks from one position of the hands to the next."""
LEG_ACCELERATION: Final = 10.0 / sqrt(3.0) / (LEG * DT) ** 2
"""1/s^2: largest acceleration of a leg, over its length."""
REST_SPEED_SHARE: Final = 0.02
"""Fraction of the knock's speed below which a body is at rest."""
GROWTH_LIMIT: Final = 1.1
"""Growth of the speed, from the third quarter of the observation to the last, above which a body is unstable."""
BALANCE_N: Final = 1e-12
"""N: the force on a body and the forces on the hands cancel to rounding."""
HAND_DIRECTION: Final = (1.0, 0.0, 0.0)
MODEL: Final = """
<mujoco>
  <option timestep="{timestep!r}" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1" pos="0 0 {floor!r}" friction="{friction!r} 0 0" solref="{soft!r} 1"/>
    <body name="body"><freejoint/>
      <geom name="body" type="box" size="{half!r} {half!r} {height!r}" mass="{mass!r}" friction="{friction!r} 0 0"
            solref="{soft!r} 1"/>
    </body>
  </worldbody>
</mujoco>
"""


class Cell(NamedTuple):
    """Case, mass of the body (kg), and stiffness of the material (N/m)."""

    case: str
    mass: float
    stiffness: float


class CellResult(NamedTuple):
    """Results of a cell.

    depth_m       penetration depth of a finger
    damping       N s/m   of material and coupling
    left          speed a second after the knock, as a fraction of the knock's
    grown         speed in the last quarter of that second over that in the third
    ripple_n      largest change of a force from tick to tick in the last quarter
    slips         slips that start between grip and release, and after the knock
    given_j       work of the forces on the hands in the cycle
    unbalanced_n  largest difference between the force on the body and minus the forces on the hands
    verdict       rests, swings, unstable, lost, failed, or deep: not run
    reason        of each verdict except rests
    """

    case: str
    mass_kg: float
    stiffness_n_per_m: float
    substeps: int
    depth_m: float
    damping_ns_per_m: float
    left: float | None = None
    grown: float | None = None
    ripple_n: float | None = None
    slips: int | None = None
    given_j: float | None = None
    unbalanced_n: float | None = None
    verdict: str = "failed"
    reason: str = ""


class PlayResult(NamedTuple):
    """Ticks of a run.

    force       (n, 2, 3)  N    on each finger
    mode        (n, 2)          of each contact
    speed       (n,)       m/s  of the body
    unbalanced             N    largest `unbalanced_n`
    """

    force: Array
    mode: Array
    speed: Array
    unbalanced: float


def count_substeps(mass: float) -> int:
    return LIGHT_SUBSTEPS if mass < LIGHT_KG else 1


def compute_damping(cell: Cell) -> float:
    """Return the damping, N s/m: a tenth of critical for the body between two springs, but at least 0.6 K T.

    A sampled spring generates energy like a damping of -K T / 2.
    """
    return max(0.2 * sqrt(cell.stiffness * cell.mass), 0.6 * cell.stiffness * DT)


def compute_force(cell: Cell) -> float:
    """Return the force, N, of a finger: half more than friction needs, and not too little to be felt."""
    weight = cell.mass * G
    carried = weight + cell.mass * LEG_ACCELERATION * MOVES_M["hold"]
    if cell.case == "balance":
        return weight
    if cell.case == "hold":
        return max(1.0, 1.5 * carried / (2.0 * FRICTION))
    dragged = FLOOR_FRICTION * weight + cell.mass * LEG_ACCELERATION * MOVES_M["drag"]
    return max(min(1.0, 10.0 * weight), 1.5 * dragged / (FRICTION - FLOOR_FRICTION))


def make_scene(cell: Cell, folder: Path) -> dict[str, Any]:
    steps = count_substeps(cell.mass)
    (folder / "body.xml").write_text(
        MODEL.format(
            timestep=DT / steps,
            soft=2.0 * DT / steps,
            floor=-1.0 if cell.case == "balance" else -HALF_M,
            friction=FLOOR_FRICTION,
            half=HALF_M,
            height=PLATE_HALF_M if cell.case == "balance" else HALF_M,
            mass=cell.mass,
        ),
        encoding="utf-8",
    )
    material = {
        "stiffness_n_per_m": cell.stiffness,
        "damping_ns_per_m": compute_damping(cell),
        "friction": {"static": FRICTION, "kinetic": 0.9 * FRICTION},
        "torsion": {"stiffness_nm_per_rad": TORSION, "friction_length_m": 0.004},
    }
    inertia = cell.mass * (2.0 * HALF_M) ** 2 / 6.0
    return {
        "finger": [{"name": name, "radius_m": RADIUS_M} for name in FINGERS],
        "rolling": {"method": "midpoint"},
        "coupling": {
            "stiffness_n_per_m": cell.stiffness,
            "damping_ns_per_m": compute_damping(cell),
            "torsional_damping_nms_per_rad": sqrt(TORSION * inertia),
        },
        "world": {
            "model": str(folder / "body.xml"),
            "substeps": steps,
            "geom": [{"name": "body", "material": material}],
        },
    }


def make_approach_path(cell: Cell) -> Array:
    """Return the centres of both fingertips (n, 2, 3) m, from their start to their final position."""
    moved, near, pressed = MOVES_M[cell.case], RADIUS_M + 0.001, RADIUS_M - compute_force(cell) / cell.stiffness
    if cell.case == "drag":
        places = [((0.0, 0.0, HALF_M + near), HAND_DIRECTION), ((0.0, 0.0, HALF_M + pressed), HAND_DIRECTION)]
        places += [((moved, 0.0, HALF_M + pressed), HAND_DIRECTION)]
    elif cell.case == "balance":
        below = -PLATE_HALF_M - RADIUS_M
        places = [((0.0, 0.0, below), HAND_DIRECTION), ((0.0, 0.0, below + moved), HAND_DIRECTION)]
    else:
        places = [
            ((-HALF_M - away, 0.0, z), (HALF_M + away, 0.0, z))
            for away, z in ((near, 0.0), (pressed, 0.0), (pressed, moved))
        ]
    u = (np.arange(LEG) + 1.0)[:, None, None] / LEG
    smooth = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    stops = [np.array(place) for place in places]
    return np.concatenate([stops[0][None], *(a + smooth * (b - a) for a, b in pairwise(stops))])


def begin(cell: Cell, folder: Path) -> Engine:
    """Return the engine with the body before contact; a balanced plate is already pressed onto its finger."""
    engine = Engine(make_scene(cell, folder), 1.0 / DT)
    if cell.case == "balance":
        engine.data.qpos[2] = -compute_force(cell) / cell.stiffness
    return engine


def measure_speed(engine: Engine) -> float:
    """Return the speed of the body, m/s: of its centre, or of the middle of a side about it."""
    velocity = engine.data.qvel
    return float(max(np.linalg.norm(velocity[:3]), HALF_M * np.linalg.norm(velocity[3:])))


def make_poses(path: Array) -> dict[str, Array]:
    """Return unrotated poses (n, 7) of each finger for centres (n, 2, 3)."""
    poses = np.zeros((*path.shape[:2], 7))
    poses[:, :, :3], poses[:, :, 3] = path, 1.0
    return {name: poses[:, at] for at, name in enumerate(FINGERS)}


def play(engine: Engine, path: Array) -> PlayResult:
    """Move the fingertips along centres (n, 2, 3)."""
    poses = make_poses(path)
    played = PlayResult(np.zeros(path.shape), np.zeros(path.shape[:2]), np.zeros(len(path)), 0.0)
    unbalanced = 0.0
    for tick in range(len(path)):
        records = engine.run({name: finger_poses[tick : tick + 1] for name, finger_poses in poses.items()})
        for at, name in enumerate(FINGERS):
            played.force[tick, at] = records[name]["force"][0]
            played.mode[tick, at] = records[name]["contact.mode"][0]
        played.speed[tick] = measure_speed(engine)
        applied = engine.data.xfrc_applied[1, :3]
        unbalanced = max(unbalanced, float(np.abs(played.force[tick].sum(axis=0) + applied).max()))
    return played._replace(unbalanced=unbalanced)


def count_slips(mode: Array) -> int:
    """Count the starts of slip: modes (n, 2)."""
    return int(np.count_nonzero(np.diff((mode == SLIDING).astype(np.int8), axis=0) > 0))


def measure(cell: Cell) -> CellResult:
    result = CellResult(*cell, count_substeps(cell.mass), compute_force(cell) / cell.stiffness, compute_damping(cell))
    if result.depth_m > 2.0 * RADIUS_M:
        return result._replace(verdict="deep", reason="it would press deeper than a fingertip is thick")
    forward = make_approach_path(cell)
    stay = np.repeat(forward[-1:], round(PAUSE_S / DT), axis=0)
    with tempfile.TemporaryDirectory() as folder:
        try:
            path = np.concatenate([forward, stay, forward[::-1]])
            cycle = play(begin(cell, Path(folder)), path)
            engine = begin(cell, Path(folder))
            engine.run(make_poses(np.concatenate([forward, stay])))
            engine.data.qvel[:] = KNOCK
            knock = measure_speed(engine)
            after = play(engine, np.repeat(forward[-1:], round(WATCH_S / DT), axis=0))
        except SafetyStop as error:
            return result._replace(reason=str(error))
    third, last = (float(after.speed[-to:][:QUARTER].max()) for to in (2 * QUARTER, QUARTER))
    result = result._replace(
        left=last / knock,
        grown=last / third if third > 0.0 else 1.0,
        ripple_n=float(np.linalg.norm(np.diff(after.force[-QUARTER:], axis=0), axis=2).max()),
        slips=count_slips(cycle.mode[LEG:-LEG]) + count_slips(after.mode),
        given_j=float(np.sum(cycle.force[:-1] * np.diff(path, axis=0))),
        unbalanced_n=max(cycle.unbalanced, after.unbalanced),
    )
    touching = after.mode[-1, : 2 if cell.case == "hold" else 1] != FREE
    return judge(result, bool(touching.all()))


def judge(result: CellResult, touching: bool) -> CellResult:
    """Return the results with verdict and reason."""
    assert result.left is not None and result.grown is not None
    if not touching:
        return result._replace(verdict="lost", reason="a finger touches it no more")
    if result.left <= REST_SPEED_SHARE:
        return result._replace(verdict="rests")
    if result.grown > GROWTH_LIMIT:
        return result._replace(verdict="unstable", reason=f"grows by {result.grown:.2f} in a quarter of a second")
    return result._replace(verdict="swings", reason="rolls on the fingertip, which no damper resists")


def measure_all() -> list[CellResult]:
    return map_with_progress("bodies", measure, [Cell(*values) for values in product(CASES, MASSES, STIFFNESSES)])
