"""Several fingers in one world: the world advances once per tick, and fingers do not affect each other's contacts."""

from __future__ import annotations

from typing import Any

import numba
import numpy as np
import pytest
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.config.load import build
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.jit.decorators import OPTIONS, entry
from softfinger.proxy.kernels.jit.pack import flatten, pack, unflatten, unpack
from softfinger.proxy.kernels.query.container import read_pose
from softfinger.proxy.kernels.step import step
from softfinger.proxy.pose_checks import PoseError
from softfinger.proxy.record import AT, FREE
from softfinger.proxy.scene import build_scene, start_state

pytestmark = pytest.mark.plain

Array = NDArray[np.float64]
DT = 1e-3
TICKS = 400
ROOM = 64
"""Number of elements after an outcome that must stay unwritten."""
THUMB = model.Finger(0.01, model.Coupling(1000.0, 1.0), 1000.0, 0.002, 0.0)
INDEX = model.Finger(0.006, model.Coupling(700.0, 0.5), 500.0, 0.001, 1e-6)
"""Two fingertips that have no parameter in common."""

RUBBER = {
    "stiffness_n_per_m": 1000.0,
    "damping_ns_per_m": 2.0,
    "friction": {"static": 0.6, "kinetic": 0.5},
    "torsion": {"stiffness_nm_per_rad": 0.05, "friction_length_m": 0.004},
}
REMEMBERS = [
    {"kind": "stick_slip", "stiffness_n_per_m": 300.0, "force_max_n": 0.2},
    {"kind": "vibration", "amplitude_n": 0.1, "frequency_hz": 120.0},
]
"""Effects with state per finger: an anchor, and a phase that pauses without contact."""
TURNS: dict[str, Any] = {"kind": "turntable", "rate_rad_per_s": 1.5}
OBJECTS: dict[str, list[dict[str, Any]]] = {
    "a table": [{"shape": "plane"}],
    "a turntable with a box on it": [
        {"shape": "plane", "motion": TURNS},
        {"shape": "box", "size_m": [0.02, 0.02, 0.02], "position_m": [0.045, 0.0, 0.0]},
    ],
}


def scene(name: str, *fingers: model.Finger) -> model.Scene:
    """Scene of the named objects, with stateful effects, and `fingers`."""
    objects = [
        {"name": f"thing {i}", "material": RUBBER, "effect": REMEMBERS, **thing}
        for i, thing in enumerate(OBJECTS[name])
    ]
    tables = {"fingertip": {"radius_m": 0.01}, "rolling": {"method": "euler_zxz"}, "object": objects}
    return build_scene(build(schema.Scene, tables, name))._replace(fingers=fingers)


def step_along(scene, values, start, state_values, poses, dt, contacts, times):
    """Run one step for each of `poses` (ticks, fingers, 7); fill contacts (ticks, fingers, ...) and times (ticks,)."""
    parameters, state = unpack(scene, values), unpack(start, state_values)
    for i in range(poses.shape[0]):
        state, found = step(parameters, state, all_poses(poses[i], state.fingers), dt)
        write_all(contacts[i], found)
        times[i] = state.world.time
    pack(state_values, state)


@entry
def pose_in(row):
    return model.Pose((row[0], row[1], row[2]), (row[3], row[4], row[5], row[6]))


@entry
def write(row, contact):
    pack(row, contact)


def all_poses(rows: Any, fingers: Any) -> Any:
    """Return one Pose per row, one row per finger."""
    return tuple(pose_in(row) for row in rows)


def write_all(rows: Any, contacts: Any) -> None:
    for row, contact in zip(rows, contacts, strict=True):
        values = flatten(contact)
        row[: len(values)] = values


@numba.extending.overload(all_poses, jit_options=OPTIONS)
def _all_poses(rows, fingers):
    if len(fingers) == 1:
        return lambda rows, fingers: (pose_in(rows[0]),)
    return lambda rows, fingers: (pose_in(rows[0]), pose_in(rows[1]))


@numba.extending.overload(write_all, jit_options=OPTIONS)
def _write_all(rows, contacts):
    if len(contacts) == 1:
        return lambda rows, contacts: write(rows[0], contacts[0])

    def two(rows, contacts):
        write(rows[0], contacts[0])
        write(rows[1], contacts[1])

    return two


def numbers(kind: Any) -> int:
    """Count the numbers of a named tuple of numbers and vectors; other fields count as one."""
    return sum(3 if part is model.Vec3 else 1 for part in kind.__annotations__.values())


def run(given: model.Scene, poses: Array) -> tuple[Array, Array, model.State]:
    """Contacts (ticks, fingers, leaves), world times (ticks,) and the final state, of poses (ticks, fingers, 7)."""
    start = start_state(given)
    leaves = numbers(model.Contact) - 1 + len(start.fingers[0].contacts) * numbers(model.ContactOutcome)
    contacts, times = np.full((*poses.shape[:2], leaves + ROOM), np.nan), np.zeros(len(poses))
    state = flatten(start)
    compiled(given, flatten(given), start, state, np.ascontiguousarray(poses), DT, contacts, times)
    assert np.isfinite(contacts[..., :leaves]).all()
    assert np.isnan(contacts[..., leaves:]).all()
    return contacts[..., :leaves], times, unflatten(start, state)


compiled = entry(step_along)


def stroke(radius: float, x: float, phase: float) -> Array:
    """Poses (TICKS, 7) that touch the table at x, press, drag, roll, spin and release it; `phase` shifts their time."""
    s = np.linspace(0.0, 2.0 * np.pi, TICKS) + phase
    poses = np.zeros((TICKS, 7))
    poses[:, 0] = x + 0.008 * np.sin(s)
    poses[:, 1] = 0.006 * np.sin(2.0 * s)
    poses[:, 2] = radius - 0.002 * np.sin(s)
    turns = np.stack([np.ones(TICKS), 0.1 * np.sin(2.0 * s), 0.05 * np.sin(3.0 * s), 0.1 * np.sin(s)], axis=1)
    poses[:, 3:] = turns / np.linalg.norm(turns, axis=1)[:, None]
    return poses


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", OBJECTS)
def test_two_fingers_on_one_object_are_two_runs_of_one(name: str) -> None:
    """On objects that do not yield, each of two fingers gets the same bits as in a run of one finger."""
    thumb, index = stroke(THUMB.radius, -0.02, 0.0), stroke(INDEX.radius, 0.03, 0.7)
    both, times, _ = run(scene(name, THUMB, INDEX), np.stack([thumb, index], axis=1))
    for place, (finger, poses) in enumerate([(THUMB, thumb), (INDEX, index)]):
        alone, times_alone, _ = run(scene(name, finger), poses[:, None])
        np.testing.assert_array_equal(both[:, place], alone[:, 0])
        np.testing.assert_array_equal(times, times_alone)
        modes = set(alone[:, 0, 0])
        assert FREE in modes and len(modes) == 3  # the stroke must reach all three modes
    assert not np.array_equal(both[:, 0], both[:, 1])


def test_order_of_fingers_changes_nothing() -> None:
    """Reversing the order of the fingers reverses the order of the results."""
    name = "a turntable with a box on it"
    thumb, index = stroke(THUMB.radius, -0.02, 0.0), stroke(INDEX.radius, 0.03, 0.7)
    one, _, _ = run(scene(name, THUMB, INDEX), np.stack([thumb, index], axis=1))
    other, _, _ = run(scene(name, INDEX, THUMB), np.stack([index, thumb], axis=1))
    np.testing.assert_array_equal(one, other[:, ::-1])


def test_world_time_advances_once_per_tick() -> None:
    """With two fingers, n ticks still advance the turntable and the world time by n dt."""
    poses = np.stack([stroke(THUMB.radius, -0.02, 0.0)] * 2, axis=1)
    given = scene("a turntable with a box on it", THUMB, THUMB)
    _, times, after = run(given, poses)
    np.testing.assert_array_equal(times, np.cumsum(np.full(TICKS, DT)))
    assert after.world.time == times[-1]
    poses = [read_pose(after.world.poses, at) for at in (0, 7)]  # of the first object, now and one tick before
    angle, before = (2.0 * np.arctan2(q[3], q[0]) for _, q in poses)
    rate = TURNS["rate_rad_per_s"]
    # An angle of up to a radian rounds to some 1e-16, and each step of time adds as much.
    assert angle == pytest.approx(rate * TICKS * DT, rel=0, abs=TICKS * 1e-15)
    assert angle - before == pytest.approx(rate * DT, rel=0, abs=TICKS * 1e-15)


@pytest.fixture(scope="module")
def pair_of_engines() -> tuple[Engine, dict[str, Engine]]:
    """Engine for two fingers with different couplings, and one engine for each finger."""
    given = {"thumb": (0.01, 1000.0), "index": (0.006, 700.0)}
    objects = [{"name": "table", "shape": "plane", "material": RUBBER}]
    rest = {"rolling": {"method": "euler_zxz"}, "object": objects}
    fingers = [
        {"name": name, "radius_m": radius, "coupling": {"stiffness_n_per_m": stiffness}}
        for name, (radius, stiffness) in given.items()
    ]
    alone = {
        name: {"fingertip": {"radius_m": radius}, "coupling": {"stiffness_n_per_m": stiffness}}
        for name, (radius, stiffness) in given.items()
    }
    both = Engine(build(schema.Scene, {"finger": fingers, **rest}, "both"))
    return both, {name: Engine(build(schema.Scene, tables | rest, name)) for name, tables in alone.items()}


def test_engine_addresses_fingers_by_name(pair_of_engines: tuple[Engine, dict[str, Engine]]) -> None:
    """Each finger gets the bits of its single-finger engine, with its coupling, for any order of the poses."""
    both, alone = pair_of_engines
    poses = {"index": stroke(0.006, 0.03, 0.7), "thumb": stroke(0.01, -0.02, 0.0)}
    found = both.run(poses)
    assert list(found) == ["thumb", "index"] == list(both.fingers)
    for name, engine in alone.items():
        np.testing.assert_array_equal(found[name], engine.run(poses[name]))
        assert len(np.unique(found[name][:, AT.contact_mode])) == 3
    again = both.run({name: rows[:1] for name, rows in poses.items()})
    assert again["thumb"][0, AT.tick] == TICKS  # a second run continues


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        (np.zeros((3, 7)), "the fingers thumb, index: give `run` poses of each by its name"),
        ({"thumb": np.ones((3, 7))}, "poses of thumb are not those of the scene's fingers: thumb, index"),
        ({"thumb": np.ones((3, 7)), "ring": np.ones((3, 7))}, "poses of thumb, ring are not those"),
        ({"thumb": np.ones((3, 7)), "index": np.ones((2, 7))}, "the same number of poses, not 3 of thumb, 2 of index"),
        ({"thumb": np.ones((3, 7)), "index": np.full((3, 7), np.nan)}, "pose 0 is"),
    ],
)
def test_poses_of_other_fingers_are_refused(
    pair_of_engines: tuple[Engine, dict[str, Engine]], poses: Any, message: str
) -> None:
    """The error names the scene's fingers and the wrong poses."""
    with pytest.raises(PoseError, match=message):
        pair_of_engines[0].run(poses)
