"""Scenes with many objects: each gives the contact of a single object of its shape."""

import copy
import importlib
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numba
import numpy as np
import pytest
import trimesh
from helpers.key_world import key_world
from references.rotation import Array

from softfinger.config import schema
from softfinger.config.load import build
from softfinger.proxy.engine import Engine, step_many
from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.jit.decorators import PLAIN
from softfinger.proxy.kernels.query.container import MAX_ENTRIES
from softfinger.proxy.kernels.shapes import closest
from softfinger.proxy.kernels.shapes.any_shape import compute_reach
from softfinger.proxy.many import make_many
from softfinger.proxy.scene import build_scene

R, TOP = 0.008, 0.02
RUBBER = {"stiffness_n_per_m": 1000.0, "friction": {"static": 0.8, "kinetic": 0.7}}
SHAPES: dict[str, dict[str, Any]] = {
    "plane": {"shape": "plane", "position_m": [0.0, 0.0, TOP]},
    "sphere": {"shape": "sphere", "radius_m": TOP},
    "cylinder": {"shape": "cylinder", "radius_m": TOP, "orientation_wxyz": [0.5**0.5, 0.0, 0.5**0.5, 0.0]},
    "cylinder with ends": {"shape": "cylinder", "radius_m": 0.03, "length_m": 2.0 * TOP},
    "capsule": {"shape": "capsule", "radius_m": 0.01, "length_m": 0.02},
    "box": {"shape": "box", "size_m": [0.05, 0.04, 2.0 * TOP]},
    "ellipsoid": {"shape": "ellipsoid", "semi_axes_m": [0.03, 0.04, TOP]},
    "torus": {
        "shape": "torus",
        "major_radius_m": 0.02,
        "minor_radius_m": 0.005,
        "position_m": [0.02, 0.0, TOP - 0.005],
    },
    "cone": {"shape": "cone", "half_angle_rad": 1.2, "position_m": [0.0, 0.0, TOP]},
}
FAR = {"name": "far", "shape": "sphere", "radius_m": 0.01, "position_m": [3.0, 0.0, 0.0], "material": RUBBER}


@pytest.fixture(scope="module", autouse=True)
def cone() -> Iterator[Any]:
    """Import another package's shape afresh; its table is registered only while a module of tests needs it."""
    folder, before = str(Path(__file__).parents[1] / "outside_shape"), list(schema.ObjectBase.added)
    loaded = sys.modules.pop("softfinger_cone", None)
    sys.path.insert(0, folder)
    yield importlib.import_module("softfinger_cone")
    sys.path.remove(folder)
    schema.ObjectBase.added[:] = before
    del sys.modules["softfinger_cone"]
    if loaded is not None:
        sys.modules["softfinger_cone"] = loaded


def scene(*entries: dict[str, Any], **tables: Any) -> schema.Scene:
    objects = [{"name": f"n{number}", "material": RUBBER} | entry for number, entry in enumerate(entries)]
    base = {"fingertip": {"radius_m": R}, "rolling": {"method": "midpoint"}}
    return build(schema.Scene, base | tables | {"object": objects}, "test")


def over_the_top(ticks: int) -> Array:
    """Poses (ticks, 7) of a fingertip that presses 1 mm into an object of height TOP, drags, rolls and spins."""
    t = np.linspace(0.0, 1.0, ticks)
    poses = np.zeros((ticks, 7))
    poses[:, 0], poses[:, 1] = 0.004 * np.sin(6.0 * t), 0.003 * np.sin(5.0 * t)
    poses[:, 2] = TOP + R - 0.001 * np.sin(np.pi * t) + 1e-5
    poses[:, 3:] = np.stack([np.ones(ticks), 0.1 * np.sin(5.0 * t), 0.2 * np.sin(3.0 * t), 0.2 * t], axis=1)
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1)[:, None]
    return poses


@pytest.mark.plain
@pytest.mark.skipif(not PLAIN, reason="compiled, each shape alone takes half a minute")
@pytest.mark.parametrize("kind", SHAPES)
def test_a_shape_among_many_gives_the_same_records(kind: str) -> None:
    """All numbers are equal except for signs of zeros, over touch, roll, slip and release."""
    alone = Engine(scene(SHAPES[kind])).run(over_the_top(100))
    among = Engine(scene(SHAPES[kind], FAR)).run(over_the_top(100))
    assert alone["contact.normal_force"].max() > 0.05 and set(alone["contact.mode"].ravel()) >= {0.0, 1.0}
    np.testing.assert_array_equal(np.asarray(among) + 0.0, np.asarray(alone) + 0.0)


@pytest.mark.plain
@pytest.mark.skipif(not PLAIN, reason="compiled, each of four scenes takes half a minute")
@pytest.mark.parametrize("company", [(), (FAR,)], ids=["alone", "among many"])
def test_a_mesh_supports_the_closed_form_of_rolling(company: tuple[dict[str, Any], ...], tmp_path: Path) -> None:
    trimesh.creation.box((50.0, 40.0, 2000.0 * TOP)).export(tmp_path / "box.stl")
    mesh = {"shape": "mesh", "file": str(tmp_path / "box.stl"), "scale": 0.001}
    rolling = {"rolling": {"method": "rotation_vector"}}
    on_box = Engine(scene(SHAPES["box"], *company, **rolling)).run(over_the_top(100))
    on_mesh = Engine(scene(mesh, *company, **rolling)).run(over_the_top(100))
    assert on_box["contact.rolled"].max() > 0.05
    # Vertices are float32 in the file: 2 cm to 1e-9 m, times 1000 N/m.
    np.testing.assert_allclose(on_mesh["force"], on_box["force"], atol=2e-6)
    np.testing.assert_allclose(on_mesh["torque"], on_box["torque"], atol=2e-6 * R)


@pytest.mark.plain
@pytest.mark.skipif(not PLAIN, reason="calls kernels from Python, which compiled ones do not allow")
@pytest.mark.parametrize("kind", SHAPES)
def test_bounding_spheres_contain_their_shapes(kind: str) -> None:
    shape = build_scene(scene(SHAPES[kind])).objects.body.shape
    points = np.random.default_rng(0).normal(size=(500, 3))
    farthest = max(np.linalg.norm(closest(shape, tuple(x))[1]) for x in 0.1 * points)
    reach = compute_reach(shape)
    assert farthest <= reach * (1.0 + 1e-12) and (farthest > 0.8 * reach or reach == np.inf)


@pytest.mark.plain
def test_the_type_does_not_depend_on_the_objects() -> None:
    few = build_scene(scene(SHAPES["plane"], SHAPES["sphere"]))
    turning = SHAPES["box"] | {"motion": {"kind": "turntable", "rate_rad_per_s": 1.0}}
    many = build_scene(scene(*SHAPES.values(), turning, *[SHAPES["box"] | {"motion": {"kind": "driven"}}] * 16))
    assert numba.typeof(few) == numba.typeof(many)
    assert (few.objects.size, many.objects.size, many.objects.movable_count) == (2.0, 26.0, 17.0)


@pytest.mark.plain
def test_more_objects_than_have_an_index_are_refused() -> None:
    body = build_scene(scene(SHAPES["plane"])).objects.body
    with pytest.raises(Exception, match=f"{MAX_ENTRIES + 1} walls and objects: at most {MAX_ENTRIES}"):
        make_many([body] * (MAX_ENTRIES + 1), (), (), None)


def test_other_objects_do_not_recompile_the_step(tmp_path: Path) -> None:
    """Only a new shape is compiled. A body never touched makes the step that of tests/server/test_world.py."""
    poses, world = over_the_top(200), key_world(tmp_path)
    expected = Engine(scene(SHAPES["sphere"], FAR, world=world)).run(poses)
    if PLAIN:
        pytest.skip("nothing is compiled")
    signatures = list(step_many.signatures)
    third = SHAPES["sphere"] | {"position_m": [1.0, 0.0, 0.0]}
    second = Engine(scene(FAR, SHAPES["cone"], third, world=world))
    records = second.run(poses)
    assert step_many.signatures == signatures
    assert records["contact.normal_force"].max() > 0.1
    moved = np.add(poses, [1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    # The same sphere a metre away: rounding of a metre at 1000 N/m is 1e-12 N.
    second.reset()
    np.testing.assert_allclose(second.run(moved)["force"], expected["force"], atol=1e-10)
    assert isinstance(second.scene.objects, model.Many)


MODEL = """
<mujoco>
  <option timestep="0.001" integrator="implicitfast"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 0.1"/>
    <geom name="left" type="box" size="0.02 0.02 0.02" pos="0 -0.06 0.02"/>
    {bodies}
  </worldbody>
</mujoco>
"""
BODY = """
    <body pos="{x} 0 0.02" euler="0 0 {turn}"><freejoint/>
      <geom type="{kind}" size="0.02 0.02 0.02" mass="0.1"/></body>"""


@pytest.mark.plain
@pytest.mark.skipif(not PLAIN, reason="compiled, a scene with bodies takes half a minute")
def test_two_fingers_on_free_bodies_are_reset_and_copied(tmp_path: Path) -> None:
    """Poses of many objects belong to the state: `reset` and a copy in mid-contact give the same bits."""
    apart, height = 0.041, 0.02
    bodies = [BODY.format(x=apart * n, turn=5 * n, kind="sphere" if n % 2 else "box") for n in (-2, -1, 0, 1, 2)]
    (tmp_path / "row.xml").write_text(MODEL.format(bodies="".join(bodies)))
    world = {"model": str(tmp_path / "row.xml"), "material": RUBBER, "substeps": 1}
    fingers = [{"name": name, "radius_m": R} for name in ("thumb", "index")]
    engine = Engine({"finger": fingers, "coupling": {"stiffness_n_per_m": 1000.0}, "world": world})
    share = np.arange(400) / 400.0
    over, push = np.zeros((400, 7)), np.zeros((400, 7))
    over[:, 0], over[:, 2] = 0.06 * share, 2.0 * height + R - 0.003 * np.sin(np.pi * share)
    over[:, 3], over[:, 6] = np.cos(0.2 * share), np.sin(0.2 * share)
    push[:, 0], push[:, 2], push[:, 3] = -2.0 * apart - height - R - 0.002 + 0.012 * share, height, 1.0
    halves = [{"thumb": over[part], "index": push[part]} for part in (slice(200), slice(200, 400))]
    first = [engine.run(half) for half in halves]
    touched = {number for half in first for rows in half.values() for number in rows["contact.object"].tolist()}
    assert len(touched) > 3  # including -1 for no object
    assert all(max(half[name]["contact.normal_force"].max() for half in first) > 0.3 for name in ("thumb", "index"))
    engine.reset()
    repeated = engine.run(halves[0])
    continued = copy.deepcopy(engine).run(halves[1])
    for name in ("thumb", "index"):
        np.testing.assert_array_equal(repeated[name], first[0][name])
        np.testing.assert_array_equal(continued[name], first[1][name])
