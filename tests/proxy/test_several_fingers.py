"""Several fingers in one world: the world advances once per tick, and fingers do not affect each other's contacts."""

import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.touching import GRIP, Array

from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels.jit.pack import unflatten
from softfinger.proxy.kernels.query.container import read_pose
from softfinger.proxy.pose_checks import PoseError
from softfinger.proxy.record import FREE, SLIDING

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


G, R, MASS = 9.81, 0.008, 0.1
STATIC, KINETIC = 0.8, 0.7
"""Friction of the finger on the body."""
HALF, THIN = 0.02, 0.005
"""Half extents of a plate, too flat to tip over."""
PLATE = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast" cone="elliptic" impratio="10"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1" friction="{floor} 0 0" solref="0.002 1"/>
    <body name="plate" pos="0 0 0.005">
      <joint type="slide" axis="1 0 0"/><joint type="slide"/>
      <geom name="plate" type="box" size="0.02 0.02 0.005" mass="0.1" friction="{floor} 0 0" solref="0.002 1"/>
    </body>
  </worldbody>
</mujoco>
"""


def finger_on_a_plate(folder: Path, floor: float) -> Engine:
    (folder / "plate.xml").write_text(PLATE.format(floor=floor), encoding="utf-8")
    material = GRIP | {"damping_ns_per_m": 2.0, "friction": {"static": STATIC, "kinetic": KINETIC}}
    world = {"model": str(folder / "plate.xml"), "geom": [{"name": "plate", "material": material}]}
    coupling = {"stiffness_n_per_m": 1000.0, "damping_ns_per_m": 4.0, "torsional_damping_nms_per_rad": 1e-4}
    tables = {"fingertip": {"radius_m": R}, "rolling": {"method": "midpoint"}}
    return Engine(tables | {"coupling": coupling, "world": world})


def go(engine: Engine, path: Array) -> tuple[Array, Array, Array]:
    """Force (n, 3), mode (n,) and the plate's velocity along x (n,); checks that the plate's force is opposite."""
    force, mode, speed = np.zeros((len(path), 3)), np.zeros(len(path)), np.zeros(len(path))
    for tick, center in enumerate(path):
        records = engine.run(np.array([[*center, 1.0, 0.0, 0.0, 0.0]]))
        force[tick], mode[tick], speed[tick] = records["force"][0], records["contact.mode"][0], engine.data.qvel[0]
        np.testing.assert_allclose(engine.data.xfrc_applied[1, :3], -force[tick], rtol=0.0, atol=1e-12)
    return force, mode, speed


def down(depth: float, ticks: int = 120) -> Array:
    u = np.clip(np.arange(ticks) / (0.5 * ticks), 0.0, 1.0)
    path = np.zeros((ticks, 3))
    path[:, 2] = 2.0 * THIN + R - depth * u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    return path


def test_a_dragged_plate_slips_when_its_inertia_exceeds_friction(tmp_path: Path) -> None:
    """Without floor friction, at a = j t = mu_s N / m; afterwards it accelerates with mu_k N / m."""
    engine, jerk, press = finger_on_a_plate(tmp_path, 0.0), 40.0, down(1e-3)
    force, _, _ = go(engine, press)
    normal = force[-1, 2]
    t = DT * np.arange(1, 280)
    path = np.repeat(press[-1:], len(t), axis=0)
    path[:, 0] = jerk * t**3 / 6.0
    force, mode, speed = go(engine, path)
    first = int(np.flatnonzero(mode == SLIDING)[0])
    assert np.max(-force[:first, 0] / force[:first, 2]) == pytest.approx(STATIC, rel=0.01)  # a tick adds 0.5 %
    # The plate swings for some ticks.
    assert jerk * t[first] == pytest.approx(STATIC * normal / MASS, abs=5.0 * jerk * DT)
    after = slice(first + 5, first + 45)
    assert np.all(mode[after] == SLIDING)
    assert np.polyfit(t[after], speed[after], 1)[0] == pytest.approx(KINETIC * normal / MASS, rel=0.01)


def test_a_pushed_plate_resists_by_floor_friction_and_inertia(tmp_path: Path) -> None:
    """mu m g + m a. To 2 %: MuJoCo makes friction convex, and a sliding body hops by micrometres."""
    floor, more, slow, faster = 0.2, 2.0, 400, 150
    engine, limit = finger_on_a_plate(tmp_path, floor), floor * MASS * G
    t = DT * np.arange(slow + faster)
    path = np.zeros((len(t), 3))
    path[:, 0] = -HALF - R + 0.01 * t + 0.5 * more * np.maximum(t - DT * slow, 0.0) ** 2
    path[:, 2] = THIN
    force, _, speed = go(engine, path)
    push = -force[:, 0]
    first = int(np.flatnonzero(push > 0.9 * limit)[0])
    assert np.abs(speed[:first]).max() < 0.2 * 0.01  # it creeps
    assert push[slow - 200 : slow].mean() == pytest.approx(limit, rel=0.02)
    assert speed[slow - 200 : slow].mean() == pytest.approx(0.01, rel=0.02)
    assert push[-50:].mean() == pytest.approx(limit + MASS * more, rel=0.02)
