"""Tests of the servo's tick at the limits of its inputs: inputs, conditions, results.

A tick must give a finite force within the guard's limits and a contact in one of its three modes for any input from the
device, and name the reason of a refusal. `try_extremes` runs every case.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from math import inf, isfinite, nan, pi
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.config.load import build
from softfinger.drivers.quaternions import exp
from softfinger.proxy.kernels.jit.pack import packed
from softfinger.proxy.record import AT, FREE, RECORD_SIZE, SLIDING
from softfinger.server.loop.guard import GUARD_NAMES, NOT_FINITE, POSE_REFUSED
from softfinger.server.loop.tick import Tuning, make_start_memory
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.simulate import run_ticks
from softfinger.server.progress import map_with_progress
from softfinger.server.verbs.schema import format_grid
from softfinger.tools.measure import Array
from softfinger.tools.stability.wrenches import try_wrenches

R: Final = 0.01
TICKS: Final = 400
FORCE_MAX_N: Final = 12.0
TORQUE_MAX_NM: Final = 0.3
GUARD: Final = schema.Guard(force_max_n=FORCE_MAX_N, torque_max_nm=TORQUE_MAX_NM, ramp_s=0.01)
ROUNDING: Final = 1e-12
"""A clamp by norm is exact to a few roundings; relative."""
SUM_TOLERANCE: Final = 1e-9
"""A force change of 0.04 N at 12 N, as at 50 kHz, is accurate to 1e-13; relative."""


class ExtremeResult(NamedTuple):
    """Result: ticks, largest force (N), modes, names of guard bits, and the fault ("" for none)."""

    name: str
    given: str
    ticks: int
    force_n: float
    modes: str
    named: str
    wrong: str


# --- scenes and motions ----------------------------------------------------------------------------


def make_scene(
    *objects: dict[str, Any],
    radius: float = R,
    method: str = "euler_zxz",
    stiffness: float = 1000.0,
    friction: tuple[float, float] = (0.6, 0.5),
) -> dict[str, Any]:
    """Return the mapping of a scene file with all parts modelled, on a plane if no object is given."""
    material = {
        "stiffness_n_per_m": stiffness,
        "friction": {"static": friction[0], "kinetic": friction[1]},
        "torsion": {"stiffness_nm_per_rad": 0.05, "friction_length_m": 0.004},
    }
    numbered = [{"name": f"thing {n}", "material": material} | obj for n, obj in enumerate(objects or PLANE)]
    return {
        "fingertip": {"radius_m": radius},
        "rolling": {"method": method},
        "coupling": {"stiffness_n_per_m": stiffness},
        "object": numbered,
    }


PLANE: Final = ({"shape": "plane"},)
BALL: Final = {"shape": "sphere", "radius_m": 0.02, "position_m": [0.0, 0.0, -0.02]}
BLOCK: Final = {"shape": "box", "size_m": [0.02, 0.02, 0.02], "position_m": [0.0, 0.0, -0.01]}
WALLS: Final = (
    {"shape": "plane"},
    {"shape": "plane", "orientation_wxyz": [0.5**0.5, 0.0, 0.5**0.5, 0.0]},
    {"shape": "plane", "orientation_wxyz": [0.5**0.5, -(0.5**0.5), 0.0, 0.0]},
)


COUNT: Final = np.arange(TICKS)
UPRIGHT: Final = np.array([1.0, 0.0, 0.0, 0.0])


def compute_turns(angles: NDArray[np.floating[Any]], axis: Sequence[float]) -> Array:
    """Return the quaternions (n, 4) of the angles (n,) rad about an axis."""
    return exp(angles[:, None] * np.asarray(axis, float) / np.linalg.norm(axis))


def press(depth: float = 0.001, radius: float = R, distance: float = 0.0, q: Array = UPRIGHT) -> Array:
    """Return poses (n, 7) that press `depth` into z = 0, move `distance` along x and half of it along y, and leave.

    q  (4,) or (n, 4)
    """
    t = np.linspace(0.0, 1.0, TICKS)
    down = np.clip(np.minimum(t, 1.0 - t) / 0.1, 0.0, 1.0)
    along = distance * np.clip((t - 0.2) / 0.6, 0.0, 1.0)
    samples = np.zeros((TICKS, 7))
    samples[:, 0], samples[:, 1] = along, 0.5 * along
    samples[:, 2] = radius * 1.2 - down * (0.2 * radius + depth)
    samples[:, 3:] = q
    return samples


ON_PLANE: Final = make_scene()
EQUAL_STEPS: Final = np.full(TICKS, 0.001)


class ExtremeCase(NamedTuple):
    """Extreme input.

    name, given   the extreme parameter, and its value
    samples       (n, 7)  poses as a device gives them
    expects       further condition on the records; returns the fault, "" for none
    scene         mapping of a scene file
    dts           (n,) s  time since the last tick
    period        s       nominal length of a tick
    refused       True if poses must be refused, False if none may be
    """

    name: str
    given: str
    samples: Array
    expects: Callable[[Array], str] = lambda records: ""
    scene: dict[str, Any] = ON_PLANE
    dts: Array = EQUAL_STEPS
    period: float = 0.001
    refused: bool = False


# --- further conditions ----------------------------------------------------------------------------


def check_touch_and_release(records: Array) -> str:
    modes = records[:, AT.contact_mode]
    if not (modes != FREE).any():
        return "nothing was touched"
    return "" if modes[-1] == FREE else "the contact did not end"


def check_slides(records: Array) -> str:
    return check_touch_and_release(records) or (
        "" if (records[:, AT.contact_mode] == SLIDING).any() else "it did not slide"
    )


def check_never_slides(records: Array) -> str:
    return check_touch_and_release(records) or ("it slid" if (records[:, AT.contact_mode] == SLIDING).any() else "")


def check_zero_refused(records: Array) -> str:
    refused = records[:, AT.servo_guard] == POSE_REFUSED
    silent = (
        not records[refused][:, AT.force : AT.force + 3].any() and not (records[refused, AT.contact_mode] != FREE).any()
    )
    return "" if silent else "a refused pose left a force or a contact"


# --- the cases -------------------------------------------------------------------------------------


def iter_cases() -> Iterator[ExtremeCase]:
    """Yield every extreme; cases of one scene type are consecutive."""
    yield from iter_plane_cases()
    yield from iter_damaged_poses()
    yield from iter_object_cases()


def iter_plane_cases() -> Iterator[ExtremeCase]:
    drag = press(distance=0.01)
    yield ExtremeCase("no rotation", "a drag without any turn", drag, check_slides)
    for angle, words in ((pi, "pi"), (pi - 1e-9, "a little less than pi"), (pi + 1e-9, "a little more than pi")):
        poses = press(q=compute_turns(angle * COUNT, (1.0, 0.3, 0.1)))
        yield ExtremeCase("rotation in one tick", f"{words} about a slanting axis, every tick", poses)
    poses = press(q=compute_turns(0.02 * COUNT, (0.0, 0.0, 1.0)))
    yield ExtremeCase("gimbal of ZXZ", "theta = 0: pure spin", poses, check_never_slides)
    poses = press(q=compute_turns(pi * COUNT, (1.0, 0.0, 0.0)))
    yield ExtremeCase("gimbal of ZXZ", "theta = pi every tick", poses)
    for radius in (1e-5, 1e3):
        poses = press(0.1 * radius, radius, radius)
        yield ExtremeCase(
            "fingertip radius", f"r = {radius:g} m", poses, check_touch_and_release, make_scene(radius=radius)
        )
    for stiffness in (1e-3, 1e6):
        model = make_scene(stiffness=stiffness)
        yield ExtremeCase("stiffness", f"K = {stiffness:g} N/m", drag, check_touch_and_release, model)
    yield ExtremeCase("friction", "mu = 0", drag, check_slides, make_scene(friction=(0.0, 0.0)))
    yield ExtremeCase("friction", "mu = 1000", drag, check_never_slides, make_scene(friction=(1e3, 1e3)))
    for rate in (8000.0, 50.0):
        dts = np.full(TICKS, 1.0 / rate)
        yield ExtremeCase("period", f"T = 1/{rate:g} s", drag, check_slides, dts=dts, period=1.0 / rate)
    missed = np.asarray(0.001 * np.random.default_rng(1).integers(1, 100, TICKS), np.float64)
    yield ExtremeCase("missed ticks", "1 to 99 at a time", drag, check_touch_and_release, dts=missed)
    yield ExtremeCase("no time passes", "dt = 0", drag, check_touch_and_release, dts=np.zeros(TICKS))
    jumps: Array = 10.0 ** np.random.default_rng(2).uniform(-9.0, 3.0, TICKS)
    yield ExtremeCase("clock that jumps", "dt from 1e-9 to 1e3 s", drag, check_touch_and_release, dts=jumps)


def iter_damaged_poses() -> Iterator[ExtremeCase]:
    for value, words in ((nan, "NaN"), (inf, "infinite"), (-inf, "minus infinite"), (1e7, "10 000 km")):
        poses = press()
        poses[100:300:7, 1] = value
        yield ExtremeCase("broken position", words, poses, check_zero_refused, refused=True)
    for norm in (0.0, 1e-3, nan, inf, 1e200):
        poses = press()
        poses[100:300:7, 3] = norm
        yield ExtremeCase("quaternion", f"of norm {norm:g}", poses, check_zero_refused, refused=True)
    for norm in (0.51, 1.99):
        poses = press()
        poses[::2, 3] = norm
        yield ExtremeCase("quaternion", f"of norm {norm:g}", poses, check_never_slides)
    subnormal = press(q=np.array([1.0, 5e-324, 5e-324, 5e-324]))
    yield ExtremeCase("subnormal numbers", "in the quaternion", subnormal, check_never_slides)
    hops = np.random.default_rng(3).uniform(-1.0, 1.0, (TICKS, 3)) * 10.0 ** np.linspace(-3.0, 6.0, TICKS)[:, None]
    poses = press()
    poses[:, :3] = hops
    yield ExtremeCase("teleporting probe", "up to 1000 km a tick, through the plane", poses)
    yield ExtremeCase("deep penetration", "1 m at 1e6 N/m", press(1.0), check_clamp, make_scene(stiffness=1e6))


def iter_object_cases() -> Iterator[ExtremeCase]:
    """Yield curvature, edges, and several contacts at once."""
    for radius, object_radius in ((1e-5, 1e3), (1e3, 1e-5), (1e3, 1e3), (1e-5, 1e-5)):
        ball = {"shape": "sphere", "radius_m": object_radius, "position_m": [0.0, 0.0, -min(object_radius, 1e3)]}
        poses = press(0.1 * min(radius, object_radius), radius, 0.1 * min(radius, object_radius))
        words = f"r = {radius:g} m on R = {object_radius:g} m"
        yield ExtremeCase("curvature", words, poses, check_touch_and_release, make_scene(ball, radius=radius))
    for sign in (1.0, -1.0):
        poses = press(q=compute_turns(sign * pi / 2 * COUNT, (0.0, 1.0, 0.0)))
        model = make_scene(BALL, method="euler_zyx")
        yield ExtremeCase("gimbal of ZYX", "pitch of pi/2 every tick", poses, scene=model)

    for place, words in (((0.01, 0.0), "edge"), ((0.01, 0.01), "corner")):
        poses = press(distance=0.004, q=compute_turns(np.linspace(0.0, 2.0, TICKS), (0.3, 1.0, 0.0)))
        poses[:, :2] += np.asarray(place) - 0.001
        words = f"of a box, rolled over its {words}"
        yield ExtremeCase("sharp object", words, poses, check_touch_and_release, make_scene(BLOCK))

    for count in (2, 3):
        poses = press(distance=0.003, q=compute_turns(np.linspace(0.0, 1.0, TICKS), (1.0, 1.0, 1.0)))
        poses[:, : count - 1] += 0.009
        poses[:, count - 1 : 2] += 0.05
        yield ExtremeCase("several contacts", f"{count} walls at once, turning", poses, scene=make_scene(*WALLS))


def check_clamp(records: Array) -> str:
    force = np.linalg.norm(records[:, AT.force : AT.force + 3], axis=1)
    return "" if force.max() > 0.99 * FORCE_MAX_N else "the clamp was not reached"


def make_case_tuning(mapping: dict[str, Any]) -> Tuning:
    return make_tuning(build(schema.Scene, mapping, "extreme"), GUARD)


def run_case(case: ExtremeCase) -> Array:
    """Return the records (n, RECORD_SIZE) of a case."""
    tuning = make_case_tuning(case.scene)
    records = np.zeros((len(case.samples), RECORD_SIZE))
    samples, rows = case.samples[:, None], records[:, None]
    run_ticks(packed(tuning), packed(make_start_memory(tuning.scene)), samples, case.dts, case.period, 0, rows)
    return records


def judge(case: ExtremeCase, records: Array) -> ExtremeResult:
    force = np.linalg.norm(records[:, AT.force : AT.force + 3], axis=1)
    modes = np.unique(records[:, AT.contact_mode])
    bits = int(np.bitwise_or.reduce(records[:, AT.servo_guard].astype(np.int64)))
    names = [name for n, name in enumerate(GUARD_NAMES) if bits >> n & 1]
    wrong = ""
    if broken := count_violations(records, case.period):
        wrong = f"{broken} ticks with a number not finite, a wrench past the guard, a jump or no mode"
    elif case.refused != bool(bits & POSE_REFUSED):
        wrong = "a pose refused" if not case.refused else "a broken pose taken"
    words = " ".join(("free", "rolling", "sliding")[int(mode)] for mode in modes if isfinite(mode))
    return ExtremeResult(
        case.name, case.given, len(records), float(force.max()), words, " ".join(names), wrong or case.expects(records)
    )


def count_violations(records: Array, period: float) -> int:
    """Count the records (n, RECORD_SIZE) of ticks of `period` (s) that violate a rule for every tick."""
    with np.errstate(invalid="ignore", over="ignore"):
        force = np.linalg.norm(records[:, AT.force : AT.force + 3], axis=1)
        torque = np.linalg.norm(records[:, AT.torque : AT.torque + 3], axis=1)
        is_within = (force <= FORCE_MAX_N * (1.0 + ROUNDING)) & (torque <= TORQUE_MAX_NM * (1.0 + ROUNDING))
        is_within &= np.isin(records[:, AT.contact_mode], (0.0, 1.0, 2.0)) & (
            records[:, AT.servo_guard] % (2 * NOT_FINITE) < NOT_FINITE
        )
        is_within &= np.isfinite(records).all(axis=1)
        for at, size, slew in (
            (AT.force, force, GUARD.force_slew_n_per_s),
            (AT.torque, torque, GUARD.torque_slew_nm_per_s),
        ):
            change = np.linalg.norm(np.diff(records[:, at : at + 3], axis=0), axis=1)
            # Change from the last tick, or from zero after a release of the force.
            is_within[1:] &= np.minimum(change, size[1:]) <= slew * period * (1.0 + SUM_TOLERANCE)
        return int(np.count_nonzero(~is_within))


def try_extremes() -> list[ExtremeResult]:
    results = map_with_progress("extremes", lambda case: judge(case, run_case(case)), list(iter_cases()))
    return results + [
        ExtremeResult("wrench", wrench, n, force, "-", names, wrong)
        for wrench, n, force, names, wrong in try_wrenches()
    ]


def format_table(results: Sequence[ExtremeResult]) -> str:
    head = ["extreme", "given", "largest force", "modes", "the guard says", "holds"]
    lines = [
        [row.name, row.given, f"{row.force_n:.3g} N", row.modes, row.named or "-", row.wrong or "yes"]
        for row in results
    ]
    return format_grid(head, lines) + "\n"
