"""Several fingers in one world: the world advances once per tick, and fingers do not affect each other's contacts."""

import functools
from typing import Any

import numpy as np
import pytest
from helpers.touching import GRIP, Array

from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels.jit.pack import unflatten
from softfinger.proxy.kernels.query.container import read_pose
from softfinger.proxy.pose_checks import PoseError
from softfinger.proxy.record import FREE

pytestmark = pytest.mark.plain

DT, TICKS = 1e-3, 400
FINGERS: dict[str, dict[str, Any]] = {
    "thumb": {"radius_m": 0.01, "coupling": {"stiffness_n_per_m": 1000.0, "damping_ns_per_m": 1.0},
              "probe": {"velocity_time_constant_s": 0.002}},
    "index": {"radius_m": 0.006, "coupling": {"stiffness_n_per_m": 700.0, "damping_ns_per_m": 0.5},
              "probe": {"velocity_time_constant_s": 0.001, "position_resolution_m": 1e-6}},
}  # fmt: skip
"""Two fingertips that have no parameter in common."""
RUBBER = GRIP | {"damping_ns_per_m": 2.0}
REMEMBERS = [
    {"kind": "stick_slip", "stiffness_n_per_m": 300.0, "force_max_n": 0.2},
    {"kind": "vibration", "amplitude_n": 0.1, "frequency_hz": 120.0},
]
"""Effects with state per finger: an anchor, and a phase that pauses without contact."""
TURNS: dict[str, Any] = {"kind": "turntable", "rate_rad_per_s": 1.5}
TABLE, TURNTABLE = "a table", "a turntable with a box on it"
OBJECTS: dict[str, list[dict[str, Any]]] = {
    TABLE: [{"shape": "plane"}],
    TURNTABLE: [
        {"shape": "plane", "motion": TURNS},
        {"shape": "box", "size_m": [0.02, 0.02, 0.02], "position_m": [0.045, 0.0, 0.0]},
    ],
}


@functools.cache
def engine(objects: str, *names: str) -> Engine:
    """Engine of the objects, with stateful effects; a single finger is a [fingertip]."""
    entries = [
        {"name": f"thing {i}", "material": RUBBER, "effect": REMEMBERS, **entry}
        for i, entry in enumerate(OBJECTS[objects])
    ]
    tables: dict[str, Any] = {"finger": [{"name": name, **FINGERS[name]} for name in names]}
    if len(names) == 1:
        tip = FINGERS[names[0]]
        tables = {"fingertip": {"radius_m": tip["radius_m"]}, "coupling": tip["coupling"], "probe": tip["probe"]}
    return Engine({"rolling": {"method": "euler_zxz"}, "object": entries, **tables})


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


STROKES = {"index": stroke(0.006, 0.03, 0.7), "thumb": stroke(0.01, -0.02, 0.0)}


@pytest.mark.sampled(1)
@pytest.mark.parametrize("objects", OBJECTS)
def test_two_fingers_on_one_object_are_two_runs_of_one(objects: str) -> None:
    for names in (("thumb", "index"), ("index", "thumb")):
        both = engine(objects, *names)
        both.reset()
        records_of = both.run(STROKES)
        assert tuple(records_of) == names == both.fingers
        for name in names:
            alone = engine(objects, name)
            alone.reset()
            records = alone.run(STROKES[name])
            np.testing.assert_array_equal(records_of[name], records)
            modes = set(records["contact.mode"])
            assert FREE in modes and len(modes) == 3  # the stroke must reach all three modes
    continued = both.run({name: rows[:1] for name, rows in STROKES.items()})
    assert continued["thumb"]["tick"][0] == TICKS  # a second run continues


def test_world_time_advances_once_per_tick() -> None:
    both = engine(TURNTABLE, "thumb", "index")
    both.reset()
    both.run(STROKES)
    world = unflatten(both._begin, both._state).world
    assert world.time == np.cumsum(np.full(TICKS, DT))[-1]
    poses = [read_pose(world.poses, at) for at in (0, 7)]  # of the first object, now and one tick before
    angle, before = (2.0 * np.arctan2(q[3], q[0]) for _, q in poses)
    rate = TURNS["rate_rad_per_s"]
    # An angle of up to a radian rounds to some 1e-16, and each step of time adds as much.
    assert angle == pytest.approx(rate * TICKS * DT, rel=0, abs=TICKS * 1e-15)
    assert angle - before == pytest.approx(rate * DT, rel=0, abs=TICKS * 1e-15)


@pytest.mark.parametrize(
    ("poses", "message"),
    [
        (np.zeros((3, 7)), "the fingers thumb, index: pass `run` the poses of each by its name"),
        ({"thumb": np.ones((3, 7))}, "poses of thumb do not match the fingers of the scene: thumb, index"),
        ({"thumb": np.ones((3, 7)), "ring": np.ones((3, 7))}, "poses of thumb, ring do not match"),
        ({"thumb": np.ones((3, 7)), "index": np.ones((2, 7))}, "the same number of poses, not 3 of thumb, 2 of index"),
        ({"thumb": np.ones((3, 7)), "index": np.full((3, 7), np.nan)}, "pose 0 is"),
    ],
)
def test_poses_of_other_fingers_are_refused(poses: Any, message: str) -> None:
    with pytest.raises(PoseError, match=message):
        engine(TABLE, "thumb", "index").run(poses)
