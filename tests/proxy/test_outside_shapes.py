"""Shapes of other packages, each in one file, named in scene files and touched like built-in shapes."""

import gc
import importlib
import os
import shutil
import sys
import weakref
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numba
import numpy as np
import pytest
from conftest import merged
from helpers.faulty_device import FaultyDevice, Options
from helpers.programs import run_program
from helpers.touching import GRIP, Array

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.config.load import build, describe, load_rig
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.kernels.jit.decorators import OPTIONS
from softfinger.proxy.kernels.shapes import closest, curvature, is_hollow, transport
from softfinger.proxy.record import FREE
from softfinger.server.loop.servo_thread import ServoThread
from softfinger.server.loop.tuning import make_tuning

OUTSIDE = Path(__file__).parents[1] / "outside_shape"
RADIUS, HALF_ANGLE = 0.01, 0.5


def outside(name: str) -> Iterator[ModuleType]:
    """Import the module of a shape, and register its table only here: other tests list all registered shapes."""
    before = list(schema.ObjectBase.added)
    sys.path.insert(0, str(OUTSIDE))
    try:
        yield importlib.import_module(name)
    finally:
        sys.path.remove(str(OUTSIDE))
        schema.ObjectBase.added[:] = before


@pytest.fixture(scope="module")
def cone() -> Iterator[ModuleType]:
    yield from outside("softfinger_cone")


@pytest.fixture(scope="module")
def beads() -> Iterator[ModuleType]:
    yield from outside("softfinger_beads")


def scene(entry: dict[str, Any], **tables: Any) -> schema.Scene:
    base = {"fingertip": {"radius_m": RADIUS}, "rolling": {"method": "euler_zxz"}}
    entry = {"name": "thing", **entry, "material": GRIP}
    return build(schema.Scene, merged(base, tables) | {"object": [entry]}, "f.toml")


@pytest.mark.plain
def test_a_shape_of_another_package_extends_the_scene_format(cone: ModuleType) -> None:
    config = scene({"shape": "cone", "half_angle_rad": HALF_ANGLE})
    assert isinstance(config.object[0], cone.ConeTable)
    assert build(schema.Scene, describe(config), "again") == config
    with pytest.raises(ConfigError, match=r"object\[0\]\.half_angle_rad = 2\.0.*1\.5.*a needle and a plane"):
        scene({"shape": "cone", "half_angle_rad": 2.0})
    with pytest.raises(ConfigError, match=r"shape = 'kone'.*did you mean 'cone'"):
        scene({"shape": "kone", "half_angle_rad": 0.5})
    with pytest.raises(ConfigError, match=r"no closed form for the cone"):
        scene({"shape": "cone", "half_angle_rad": 0.5}, rolling={"method": "rotation_vector"})
    up, shape = (0.0, 0.0, 1.0), cone.Cone(0.6, 0.8)
    assert not is_hollow(shape) and transport(shape, (1.0, 0.0, 0.0), up, up) == (1.0, 0.0, 0.0)  # defaults


@pytest.mark.plain
def test_a_tag_is_registered_once(cone: ModuleType) -> None:
    before = list(schema.ObjectBase.added)
    for tag in ("cone", "sphere"):

        class Again(schema.ObjectBase, frozen=True, kw_only=True, tag_field="shape", tag=tag):
            shape = tag

        with pytest.raises(TypeError, match=f"there is a shape '{tag}' already"):
            schema.add_shape(Again)

    class Untagged(schema.ObjectBase, frozen=True, kw_only=True):
        shape = "untagged"

    with pytest.raises(TypeError, match="tag_field"):
        schema.add_shape(Untagged)
    assert schema.ObjectBase.added == before


@pytest.mark.plain
def test_cone_agrees_with_sampled_points(cone: ModuleType) -> None:
    """The gap is the distance to the closest of many points of the flank."""
    rng = np.random.default_rng(1)
    s, c = np.sin(HALF_ANGLE), np.cos(HALF_ANGLE)
    spacing = 1e-4
    # in the half plane through the axis: distance from it, and z
    line = np.arange(0.0, 0.3, spacing)[:, None] * [s, -c]
    for x in rng.uniform(-0.1, 0.1, (50, 3)):
        gap, point, normal = closest(cone.Cone(s, c), tuple(x))
        level = np.hypot(x[0], x[1])
        nearest = np.hypot(*(line - [level, x[2]]).T).min()
        # Any point of the line is at most half a spacing from a sample.
        assert abs(abs(gap) - nearest) <= 0.5 * spacing and (gap < 0.0) == (level * c + x[2] * s < 0.0)
        np.testing.assert_allclose(np.add(point, np.multiply(gap, normal)), x, atol=1e-15)


@pytest.mark.plain
def test_curvature_of_cone_is_the_rotation_of_its_normal(cone: ModuleType) -> None:
    shape, step = cone.Cone(np.sin(HALF_ANGLE), np.cos(HALF_ANGLE)), 1e-6
    for x in ((0.02, 0.01, -0.01), (0.003, 0.0, 0.002), (0.0, 0.001, 0.02)):
        _, point, normal = closest(shape, x)
        center = np.add(point, np.multiply(RADIUS, normal))
        k1, k2, d1 = curvature(shape, RADIUS, point, normal)
        for k, d in ((k1, np.array(d1)), (k2, np.cross(normal, d1))):
            ahead, behind = (closest(shape, tuple(center + signed * d))[2] for signed in (step, -step))
            # Central differences have an error of the square of the step, and rounding divided by it.
            np.testing.assert_allclose(np.subtract(ahead, behind) / (2.0 * step), k * d, atol=1e-6 * max(k1, 1.0))


@pytest.mark.plain
def test_touching_a_cone_is_touching_its_tangent_plane(cone: ModuleType) -> None:
    """Along a straight line of the flank the normal curvature is zero: the plane is the closed form of every column."""
    s, c = np.sin(HALF_ANGLE), np.cos(HALF_ANGLE)
    normal, along, across = np.array([c, 0.0, s]), np.array([s, 0.0, -c]), np.array([0.0, 1.0, 0.0])
    tick = np.arange(401)  # one change at a time: simultaneous roll and spin would leave the straight line
    depth = np.interp(tick, [0, 80, 400], [-0.00101, 0.001, 0.001])  # no tick at a depth of zero
    roll = np.interp(tick, [80, 160], [0.0, 0.3])
    spin = np.interp(tick, [160, 240], [0.0, 0.2])
    drag = np.interp(tick, [240, 400], [0.0, 0.01])
    poses = np.zeros((len(tick), 7))
    poses[:, :3] = 0.05 * along + np.outer(RADIUS - depth, normal) + np.outer(drag, along)
    for row, a, b in zip(poses, roll, spin, strict=True):
        first = np.concatenate([[np.cos(a / 2)], np.sin(a / 2) * across])
        second = np.concatenate([[np.cos(b / 2)], np.sin(b / 2) * normal])
        row[3] = first[0] * second[0] - first[1:] @ second[1:]
        row[4:] = first[0] * second[1:] + second[0] * first[1:] + np.cross(second[1:], first[1:])
    turn = np.arctan2(c, s)  # rotation of the plane about y that turns its z axis to the normal
    tilted = {"shape": "plane", "orientation_wxyz": [np.cos(turn / 2), 0.0, np.sin(turn / 2), 0.0]}
    on_cone = Engine(scene({"shape": "cone", "half_angle_rad": HALF_ANGLE})).run(poses)
    on_plane = Engine(scene(tilted)).run(poses)
    assert {0, 1, 2} <= set(on_cone["contact.mode"].ravel().astype(int))
    assert on_cone["contact.rolled"].max() > 0.9 * RADIUS * 0.3
    # Forces of about 1 N at 1000 N/m: 1e-9 N is a picometre, far above rounding and below any modelling error.
    np.testing.assert_allclose(on_cone, on_plane, atol=1e-9)


TOUCH = """
import sys
sys.path.insert(0, sys.argv[1])
import softfinger_beads
from softfinger.config.load import load_scene
from softfinger.proxy.engine import Engine, step_many
table = {"name": "thing", "shape": "beads", "balls_file": sys.argv[2], "material": {"stiffness_n_per_m": 1000.0}}
scene = load_scene({"fingertip": {"radius_m": 0.01}, "object": [table]})
step = Engine(scene).step((0.0, 0.0, 0.0099), (1.0, 0.0, 0.0, 0.0))
print(round(step.force[2], 9), sum(step_many.stats.cache_hits.values()))
"""


def touched(folder: Path, balls_file: Path) -> str:
    """Return the force of a touch and the number of cache hits, from a new process with its cache in the folder."""
    environment = os.environ | {"SOFTFINGER_CACHE_DIR": str(folder / "cache")}
    script = folder / "touch.py"  # code from a command line is not cached
    script.write_text(TOUCH)
    command = [sys.executable, "-B", str(script), str(folder), str(balls_file)]
    return run_program(command, env=environment, check=True).stdout.strip()


BALLS = np.array([[0.0, 0.0, -0.02, 0.02], [0.05, 0.0, -0.03, 0.03], [0.0, 0.08, -0.01, 0.01]])


@pytest.fixture
def balls_file(tmp_path: Path) -> Path:
    np.savetxt(tmp_path / "balls.txt", BALLS, fmt="%.17g")
    return tmp_path / "balls.txt"


def beads_of(file: Path) -> dict[str, Any]:
    return {"shape": "beads", "balls_file": str(file)}


def rolling_over(ball: Array) -> Array:
    t = np.linspace(0.0, 1.0, 300)
    poses = np.zeros((len(t), 7))
    depth = np.interp(t, [0.0, 0.2, 1.0], [-0.001, 0.001, 0.001])
    tilt = np.interp(t, [0.0, 0.5, 1.0], [0.0, 0.0, 0.3])
    away = np.stack([np.sin(tilt), np.zeros_like(t), np.cos(tilt)], axis=1)
    poses[:, :3] = ball[:3] + (ball[3] + RADIUS - depth)[:, None] * away
    roll = np.interp(t, [0.0, 0.2, 0.5, 1.0], [0.0, 0.0, 0.1, 0.1])
    poses[:, 3], poses[:, 5] = np.cos(0.5 * roll), np.sin(0.5 * roll)
    return poses


@pytest.mark.plain
def test_balls_of_an_array_equal_spheres(beads: ModuleType, balls_file: Path) -> None:
    engine = Engine(scene(beads_of(balls_file)))
    for ball in BALLS:
        sphere = {"shape": "sphere", "radius_m": ball[3], "position_m": ball[:3].tolist()}
        poses = rolling_over(ball)
        engine.reset()
        expected = Engine(scene(sphere)).run(poses)
        records = engine.run(poses)
        assert (records["contact.mode"] != FREE).mean() > 0.5
        np.testing.assert_allclose(records, expected, atol=1e-9)  # 1e-9 N is a picometre at 1000 N/m


def test_an_array_lives_as_long_as_its_engine(beads: ModuleType, balls_file: Path) -> None:
    config = scene(beads_of(balls_file))
    engine = Engine(config)
    was = weakref.ref(engine.scene.objects.body.shape.balls.array)
    gc.collect()
    assert was() is not None
    engine.run(rolling_over(BALLS[0]))
    engine.tune(config)
    gc.collect()
    now = weakref.ref(engine.scene.objects.body.shape.balls.array)
    assert was() is None and now() is not None
    engine.run(rolling_over(BALLS[0]))
    del engine
    gc.collect()
    assert now() is None


def test_a_servo_keeps_an_array_while_its_loop_may_read_it(beads: ModuleType, balls_file: Path) -> None:
    """A replaced array is released after two complete ticks, because the first may still have read it."""
    rig, config = load_rig("replay"), scene(beads_of(balls_file))
    servo = ServoThread([FaultyDevice(Options())], make_tuning(config, rig.guard), 1000.0)
    array = [servo.tuning.scene.objects.body.shape.balls.array]
    references = []
    for ticks in (0, 1, 2, 3, 5):  # done by the loop, before each change
        servo.shared.progress[0] = ticks
        servo.tune(make_tuning(config, rig.guard))
        array.append(servo._recent_tunings[-1].scene.objects.body.shape.balls.array)
        references.append(weakref.ref(array.pop(0)))
        gc.collect()
        # The first of the replaced ones is an argument of the loop.
        alive = [reference() is not None for reference in references]
        assert alive == ([True] * (ticks + 1) if ticks < 5 else [True, False, False, False, True])
    servo.close()


def test_an_array_is_read_only(beads: ModuleType) -> None:
    array = np.arange(6.0).reshape(2, 3)
    read_only = ReadOnly(array)
    array[0, 0] = 7.0
    assert read_only[0] == 0.0 and len(read_only) == 6 and not read_only.array.flags.writeable
    for name in ("float64", "float32", "int64", "int32"):
        values = ReadOnly(np.arange(5).astype(name))

        @numba.njit(**OPTIONS)
        def third(values: Any) -> Any:
            return values[3] + values[1]

        assert third(values) == 4

    @numba.njit(**OPTIONS)
    def write(values: Any) -> None:
        values[0] = 1.0

    with pytest.raises(numba.TypingError):
        write(read_only)
    with pytest.raises(TypeError, match="complex128"):
        ReadOnly(np.zeros(3, complex))


@pytest.mark.exhaustive
def test_an_outlined_kernel_is_linked_to_a_cached_caller(tmp_path: Path, balls_file: Path) -> None:
    """A caller loaded from disk calls the query it was compiled with; editing the query compiles both again."""
    file = tmp_path / "softfinger_beads.py"
    shutil.copy(OUTSIDE / file.name, file)
    assert touched(tmp_path, balls_file) == "0.1 0" and touched(tmp_path, balls_file) == "0.1 1"
    text = file.read_text()
    assert "return least, center, radius" in text
    file.write_text(text.replace("return least, center, radius", "return least + 5e-5, center, radius - 5e-5"))
    assert touched(tmp_path, balls_file) == "0.05 0" and touched(tmp_path, balls_file) == "0.05 1"
