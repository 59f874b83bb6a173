"""Objects out of reach and copies of an object change no bit, a contact that sticks has a constant normal, and no
depth is negative. r = 10 mm, R = 20 mm, K = K_t = 1000 N/m. While a contact sticks with the proxy at c, the force on a
probe at x is K (c - x): pressed d deep and dragged by e, K d n - K e."""

from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers import meshes, touching
from helpers.examples import Cases
from helpers.hostile_meshes import bar
from helpers.touching import Array, posed, spun, write_part
from references.laws import LAWS
from references.rotation import quaternion

from softfinger.config.load import load_scene
from softfinger.proxy.engine import Engine
from softfinger.proxy.record import NAMED

pytestmark = pytest.mark.plain

R, BALL, K = 0.01, 0.02, 1000.0
GRIP = touching.GRIP | {"damping_ns_per_m": 1.0}
STICKY: dict[str, Any] = {"stiffness_n_per_m": K, "friction": {"static": 50.0, "kinetic": 50.0}}
SHAPES: dict[str, dict[str, Any]] = {
    "plane": {"shape": "plane"},
    "sphere": {"shape": "sphere", "radius_m": BALL},
    "cylinder": {"shape": "cylinder", "radius_m": BALL},
    "capped cylinder": {"shape": "cylinder", "radius_m": BALL, "length_m": 0.03},
    "capsule": {"shape": "capsule", "radius_m": 0.015, "length_m": 0.02},
    "box": {"shape": "box", "size_m": [0.04, 0.035, 0.03]},
    "ellipsoid": {"shape": "ellipsoid", "semi_axes_m": [0.025, 0.02, 0.015]},
    "torus": {"shape": "torus", "major_radius_m": 0.03, "minor_radius_m": 0.012},
    "hollow sphere": {"shape": "sphere", "radius_m": 0.03, "inside": True},
    "hollow cylinder": {"shape": "cylinder", "radius_m": 0.03, "inside": True},
    "hollow capsule": {"shape": "capsule", "radius_m": 0.025, "length_m": 0.02, "inside": True},
    "moving sphere": {
        "shape": "sphere",
        "radius_m": BALL,
        "motion": {"kind": "turntable", "axis": [0.6, 0.0, 0.8], "rate_rad_per_s": 2.0, "pivot_m": [0.002, 0.0, 0.0]},
    },
}
METHODS = ["euler_zxz", "euler_zyx", "rotation_vector", "midpoint", "montana_rk4", "montana_rk45", None]
WITHOUT_CLOSED_FORM = {"ellipsoid", "torus", "mesh box", "mesh ball", "heightmap"}
FAR = [
    {"name": "far box", "shape": "box", "size_m": [0.01, 0.01, 0.01], "position_m": [3.0, 0.0, 0.0]},
    {"name": "far sphere", "shape": "sphere", "radius_m": 0.05, "position_m": [0.0, 3.0, 0.0]},
    {"name": "far plane", "shape": "plane", "position_m": [0.0, 0.0, -3.0]},
]
SHIFTED = ["contact.object", *(f"contacts{i}.object" for i in range(3))]
"""Fields with an object index, which changes if other objects precede the object."""


def engine(objects: Sequence[dict[str, Any]], method: str | None = None, **tables: Any) -> Engine:
    own: dict[str, Any] = {"fingertip": None, "coupling": None} if "finger" in tables else {}
    own["rolling"] = None if method is None else {"method": method}
    return touching.engine(*objects, **own | tables)


def make_table(shape: str, folder: Path, material: dict[str, Any]) -> dict[str, Any]:
    if shape == "heightmap":
        x = 1e-3 * (np.arange(40) - 19.5)
        np.save(folder / "hills.npy", 2e-3 * np.cos(200.0 * x[:, None]) * np.cos(170.0 * x))
        keys = {"file": str(folder / "hills.npy"), "pitch_m": 1e-3, "level_m": 1.0}
        return {"name": "it", "shape": shape, **keys, "material": material}
    solids = {"mesh box": lambda: bar(0.02, 0.0175, 0.015), "mesh ball": lambda: meshes.geodesic(6, BALL)}
    if shape in solids:
        file = write_part(folder, *solids[shape]())
        return {"name": "it", "shape": "mesh", "file": file, "material": material}
    return {"name": "it", **SHAPES[shape], "material": material}


def handling(ticks: int, seed: int, reach: float) -> Array:
    """Poses (n, 7) of a hand that turns and moves in and out of an object `reach` m about the origin."""
    rng = np.random.default_rng(seed)
    t = np.arange(ticks)[:, None] * 1e-3

    def wave(size: float, frequencies: tuple[float, float]) -> Array:
        rate, phase = rng.uniform(*frequencies, (2, 3)), rng.uniform(0.0, 2.0 * np.pi, (2, 3))
        part = size * np.sin(2.0 * np.pi * rate[:, None] * t + phase[:, None])
        return np.asarray(part.sum(axis=0))

    turn = quaternion(wave(0.4, (0.5, 2.0)))
    return posed(wave(reach, (0.5, 3.0)), turn)


def assert_same_but_for_numbers(alone: Any, company: Any, before: int) -> None:
    assert (alone["contact.mode"] > 0).mean() > 0.2
    alone, company = np.array(alone), np.array(company)
    for name in SHIFTED:
        field = company[:, NAMED[name].at]
        field[field >= 0.0] -= before
    # + 0.0: the sign of a zero depends on the pose of objects, which a single object may not have.
    np.testing.assert_array_equal((company + 0.0).view(np.int64), (alone + 0.0).view(np.int64))


def check_out_of_reach(shape: str, method: str | None, folder: Path, material: dict[str, Any], **tables: Any) -> None:
    far = FAR[1:] if "radii_m" in tables.get("fingertip", {}) else FAR  # an ellipsoid cannot touch boxes
    it, others = make_table(shape, folder, material), [entry | {"material": material} for entry in far]
    poses = handling(300, 11, 0.012 if "hollow" in shape else 0.016)[::2]
    if shape in ("plane", "heightmap"):
        poses[:, 2] += R
    alone, company = engine([it], method, **tables), engine([others[0], it, *others[1:]], method, **tables)
    if "finger" in tables:
        both = {"thumb": poses, "index": handling(300, 12, 0.016)[::2]}
        single, several = alone.run(both), company.run(both)
        for name in both:
            assert_same_but_for_numbers(single[name], several[name], 1)
        return
    assert_same_but_for_numbers(alone.run(poses), company.run(poses), 1)


@pytest.mark.sampled(15)
@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("shape", [*SHAPES, "heightmap", "mesh box", "mesh ball"])
def test_an_object_out_of_reach_changes_no_bit(shape: str, method: str | None, tmp_path: Path) -> None:
    if method == "rotation_vector" and shape in WITHOUT_CLOSED_FORM:
        pytest.skip("rotation_vector has no closed form on it")
    check_out_of_reach(shape, method, tmp_path, GRIP)


FLOOR = {"shape": "plane", "position_m": [-R, 0.0, -R]}
TOUCHED: dict[str, tuple[list[dict[str, Any]], list[float]]] = {
    "ball": ([SHAPES["sphere"]], [0.0, 0.0, BALL + R]),
    "two balls": ([SHAPES["sphere"] | {"position_m": [x, 0.0, 0.0]} for x in (-0.015, 0.015)], [0.0, 0.0, 0.0245]),
    "groove": ([FLOOR, FLOOR | {"orientation_wxyz": [np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]}], [-1e-3, 0.0, -1e-3]),
}
"""Objects, and a position of the fingertip at which it touches all of them, m."""


@pytest.mark.parametrize("surface", ["mesh ball", "heightmap"])
@pytest.mark.parametrize("name", [*TOUCHED, "mesh ball", "mesh box"])
def test_a_mesh_or_height_map_out_of_reach_changes_no_bit(name: str, surface: str, tmp_path: Path) -> None:
    poses = handling(100, 11, 0.016 if name.startswith("mesh") else 1e-3)
    if name in TOUCHED:
        shapes, start = TOUCHED[name]
        objects = [{"name": f"it {i}", **keys, "material": GRIP} for i, keys in enumerate(shapes)]
        poses[:, :3] += start
    else:
        objects = [make_table(name, tmp_path, GRIP)]
    (folder := tmp_path / "far").mkdir()
    far = make_table(surface, folder, GRIP) | {"name": "far", "position_m": [3.0, 0.0, -3.0]}
    alone, company = engine(objects, "midpoint"), engine([far, *objects], "midpoint")
    assert_same_but_for_numbers(alone.run(poses), company.run(poses), 1)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_same_object_twice_is_one(shape: str, tmp_path: Path) -> None:
    it = make_table(shape, tmp_path, GRIP)
    for seed in (11, 13):
        poses = handling(200, seed, 0.012 if "hollow" in shape else 0.016)
        alone, twice = engine([it], "euler_zxz"), engine([it, it | {"name": "copy"}], "euler_zxz")
        assert_same_but_for_numbers(alone.run(poses), twice.run(poses), 0)


NORMALS = {
    "power law": {"normal": {"exponent": 1.5}},
    "Hunt-Crossley": {"normal": {"exponent": 1.5, "damping_s_per_m": 0.5}, "damping_ns_per_m": None},
}


TWO = [{"name": name, "radius_m": R, "coupling": {"stiffness_n_per_m": K}} for name in ("thumb", "index")]
OVAL = {"radii_m": [0.01, 0.008, 0.012]}


@pytest.mark.parametrize(
    ("shape", "tables"),
    [*((shape, {"fingertip": OVAL}) for shape in ("plane", "sphere", "cylinder")), ("ellipsoid", {"finger": TWO})],
)
def test_an_object_out_of_reach_changes_no_bit_for_any_fingertip(shape: str, tables: Any, tmp_path: Path) -> None:
    check_out_of_reach(shape, "midpoint", tmp_path, GRIP, **tables)


@pytest.mark.sampled(6)
@pytest.mark.parametrize("law", [*LAWS, *NORMALS, "paper", "patch"])
@pytest.mark.parametrize("shape", ["sphere", "box"])
def test_an_object_out_of_reach_changes_no_bit_under_any_law(shape: str, law: str, tmp_path: Path) -> None:
    material: dict[str, Any] = dict(GRIP)
    for key, change in {**LAWS, **NORMALS}.get(law, {}).items():
        material[key] = {**material.get(key, {}), **change} if isinstance(change, dict) else change
    tables: dict[str, Any] = {}
    if law == "paper":
        tables["rolling"] = {"method": "euler_zxz", "state_machine": "paper"}
    if law == "patch":
        material["torsion"] = {"model": "limit_surface"}
        tables["fingertip"] = {"radius_m": R, "patch": {"shear_modulus_pa": 45000.0}}
    material = {key: value for key, value in material.items() if value is not None}
    method = None if law.startswith("frictionless") or law == "paper" else "euler_zxz"
    check_out_of_reach(shape, method, tmp_path, material, **tables)


def line(*corners: Sequence[float], ticks: int = 50) -> Array:
    legs = [np.linspace(a, b, ticks, endpoint=False) for a, b in pairwise(corners)]
    return posed(np.concatenate([*legs, [corners[-1]]]))


LYING = {**SHAPES["cylinder"], "orientation_wxyz": [np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]}
TOPS: dict[str, tuple[dict[str, Any], tuple[float, float, float]]] = {
    "plane": (SHAPES["plane"], (0.0, 0.0, R)),
    "sphere": (SHAPES["sphere"], (0.0, 0.0, BALL + R)),
    "cylinder": (LYING, (0.0, 0.0, BALL + R)),
    "ellipsoid": (SHAPES["ellipsoid"], (0.0, 0.0, 0.015 + R)),
    "torus": (SHAPES["torus"], (0.03, 0.0, 0.012 + R)),
    "box": (SHAPES["box"], (0.0, 0.0, 0.015 + R)),
}
"""Objects, and the centre of a fingertip that touches the top of each, m."""


@pytest.mark.parametrize("deep", [1e-3, 3e-3])
@pytest.mark.parametrize("shape", TOPS)
def test_a_contact_that_sticks_is_a_spring_to_the_stuck_point(shape: str, deep: float) -> None:
    """On a random closed path, at any depth and curvature, the force is K (c - x): it does no work in a cycle."""
    keys, c = TOPS[shape]
    running = engine([{"name": "it", **keys, "material": STICKY}])
    for seed in range(3):
        running.reset()
        below = c + np.random.default_rng(seed).uniform([-6e-4, -6e-4, -1.4 * deep], [6e-4, 6e-4, -0.6 * deep], (4, 3))
        above, down = np.add(c, [0.0, 0.0, 1e-3]), np.add(c, [0.0, 0.0, -deep])
        poses = line(*[corner.tolist() for corner in (above, down, *below, down, above)], ticks=25)
        records = running.run(poses)
        touching = poses[:, 2] < c[2]
        np.testing.assert_array_equal(records["contact.mode"] > 0, touching)
        np.testing.assert_allclose(records["force"][touching], K * (c - poses[touching, :3]), atol=1e-9)
        np.testing.assert_allclose(records["contact.normal"][touching] @ [0.0, 0.0, 1.0], 1.0, atol=1e-12)


@pytest.mark.parametrize("method", ["euler_zxz", "rotation_vector", "midpoint"])
def test_a_roll_at_a_fixed_position_turns_the_normal(method: str) -> None:
    """A roll of 0.03 rad, 3 mm deep: the force is K (c - x), and the torque r times its tangential part."""
    it = {"name": "it", **SHAPES["sphere"], "material": STICKY}
    top, deep, turn = BALL + R, 3e-3, 0.03
    down = line((0.0, 0.0, top + 1e-3), (0.0, 0.0, top - deep))
    angle = np.linspace(0.0, turn, 51)
    poses = np.tile(down[-1], (51, 1))
    poses[:, 3], poses[:, 4] = np.cos(0.5 * angle), np.sin(0.5 * angle)
    last = engine([it], method).run(np.vstack([down, poses]))[-1]
    tilt = turn * R / top
    n, x = np.array([0.0, -np.sin(tilt), np.cos(tilt)]), np.array([0.0, 0.0, top - deep])
    force = K * (top * n - x)
    # The Euler methods and the midpoint rule follow the arc of a tick to third order: 0.6 mrad, fifty times.
    np.testing.assert_allclose(last[NAMED["force"].at :][:3], force, atol=1e-6)
    tangential = force - (force @ n) * n
    np.testing.assert_allclose(last[NAMED["torque"].at :][:3], -R * np.cross(n, tangential), atol=1e-8)


@pytest.mark.sampled(4)
@pytest.mark.parametrize("kind", ["box", "mesh"])
@pytest.mark.parametrize("deep", [1e-3, 3e-3, 5e-3, 6e-3])
def test_a_contact_that_sticks_to_an_edge_at_any_depth(deep: float, kind: str, tmp_path: Path) -> None:
    """A drag across an edge, below its bisector, gives -K e; a frictionless proxy would swing by d e / (r - d)."""
    half = 0.02
    if kind == "box":
        it = {"name": "it", "shape": "box", "size_m": [2 * half] * 3, "material": STICKY}
    else:
        it = {"name": "it", "shape": "mesh", "file": write_part(tmp_path, *bar(half, half, half)), "material": STICKY}
    n, across = np.array([1.0, 0.0, 1.0]) / np.sqrt(2.0), np.array([1.0, 0.0, -1.0]) / np.sqrt(2.0)
    corner = np.array([half, 0.0, half])
    places = [corner + (R + 1e-3) * n, corner + (R - deep) * n, corner + (R - deep) * n + 2e-4 * across]
    force = engine([it]).run(line(*[p.tolist() for p in places]))[-1][NAMED["force"].at :][:3]
    np.testing.assert_allclose([force @ n, force @ across], [K * deep, -0.2], atol=1e-5)


def test_a_pinched_ball_swings_by_its_two_tangential_springs() -> None:
    """Two sticking fingertips, 1 mm deep, act on a sphere of mass m as a spring of 2 K_t: sqrt(2 K_t / m)."""
    mass, deep, dt = 0.05, 1e-3, 1e-4
    driven = {"name": "it", **SHAPES["sphere"], "material": STICKY, "motion": {"kind": "driven"}}
    coupling = {"stiffness_n_per_m": K, "damping_ns_per_m": 0.0}
    fingers = [{"name": name, "radius_m": R, "coupling": coupling} for name in ("thumb", "index")]
    running = engine([driven], finger=fingers)
    far_out, near = BALL + R + 1e-4, BALL + R - deep
    pinch = {
        name: line((0.0, 0.0, side * far_out), (0.0, 0.0, side * near), ticks=20)
        for name, side in (("thumb", -1.0), ("index", 1.0))
    }
    running.run(pinch, dt)
    # The squared frequency follows from the force on the sphere at a small displacement, compared with 2 K_t.
    u = 2e-5
    running.set("object.it.position_m", [u, 0.0, 0.0])
    records = running.run({name: poses[-1:] for name, poses in pinch.items()}, dt)
    on_ball = -sum(float(record["force"][-1, 0]) for record in records.values())
    frequency, expected = np.sqrt(-on_ball / u / mass), np.sqrt(2.0 * K / mass)
    assert frequency == pytest.approx(expected, rel=1e-4)


def over_a_box(seed: int, half: tuple[float, float, float], ticks: int) -> Array:
    """Positions (n, 3) m of a random path round a box, over faces, edges and corners, up to 1.7 mm deep."""
    rng, t = np.random.default_rng(seed), np.arange(ticks) * 1e-3
    size, rate, phase = rng.normal(0.0, 1.0, (3, 3)), rng.uniform(0.3, 1.5, 3), rng.uniform(0.0, 6.0, 3)
    out = np.sin(2.0 * np.pi * np.outer(t, rate) + phase) @ size
    out /= np.linalg.norm(out, axis=1, keepdims=True)
    beyond = out / np.max(np.abs(out) / half, axis=1, keepdims=True) + 0.02 * out
    foot = np.clip(beyond, -np.array(half), half)
    normal = (beyond - foot) / np.linalg.norm(beyond - foot, axis=1, keepdims=True)
    return np.asarray(foot + (R - (1e-3 * np.sin(2.0 * np.pi * 1.3 * t + 1.0) + 7e-4))[:, None] * normal)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("seed", [2, 3])
def test_a_mesh_of_a_box_equals_the_box(seed: int, tmp_path: Path) -> None:
    """The tolerance is that of float32 vertices, 1e-9 m, times 1000 N/m. No tick's path enters and leaves an edge,
    which is a touch of the shape and none of the mesh."""
    half = (0.02, 0.0175, 0.015)
    box = {"name": "it", "shape": "box", "size_m": [2.0 * h for h in half], "material": GRIP}
    mesh = {"name": "it", "shape": "mesh", "file": write_part(tmp_path, *bar(*half)), "material": GRIP}
    poses = posed(over_a_box(seed, half, 700), spun((0.6, 0.0, 0.8), 0.2 * np.sin(0.012 * np.arange(700))))
    solid, made = engine([box], "midpoint").run(poses), engine([mesh], "midpoint").run(poses)
    assert {0.0, 1.0, 2.0} <= set(solid["contact.mode"])
    faces, edges, corners = ((np.count_nonzero(solid["contact.normal"], axis=1) == n).sum() for n in (1, 2, 3))
    assert min(faces, edges, corners) > 10
    for name, tolerance in (("force", 1e-6), ("torque", 1e-8), ("contact.point", 1e-9), ("proxy.position", 1e-9)):
        np.testing.assert_allclose(made[name], solid[name], atol=tolerance)


ROOM = {"shape": "box", "size_m": [0.05, 0.05, 0.05], "inside": True}
NORMAL = (
    {"damping_ns_per_m": 1.0},
    {"normal": {"exponent": 1.5}},
    {"normal": {"exponent": 2.0, "damping_s_per_m": 1.0}},
)
FRICTION = ({"friction": {"static": 10.0, "kinetic": 9.0}}, {"friction": {"static": 0.6, "kinetic": 0.5}}, {})


def random_poses(rng: np.random.Generator, ticks: int) -> Array:
    """Poses (ticks, 7) in and out of an object at the origin, by up to 5 mm and 0.2 rad per tick."""
    t = 0.001 * np.arange(ticks)[:, None]
    rates, phases = rng.uniform(2.0, 40.0, (3, 3)), rng.uniform(0.0, 6.0, (3, 3))
    points = sum(np.sin(rates[k] * t + phases[k]) for k in range(3)) * rng.uniform(0.002, 0.02) + [0.0, 0.0, 0.012]
    angles = np.cumsum(rng.normal(0.0, 0.05, (ticks, 1)), axis=0)
    axis = rng.normal(size=3)
    axis /= np.linalg.norm(axis)
    return posed(points, spun(axis, 2.0 * angles[:, 0]))


@pytest.mark.sampled(6)
@pytest.mark.scaled
@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("shape", [*SHAPES, "room", "heightmap", "mesh ball"])
def test_the_depth_is_never_negative(shape: str, count: int, cases: Cases, tmp_path: Path) -> None:
    """With a second object, and with friction that displaces the proxy far from the probe."""
    rng, touched = np.random.default_rng(len(shape)), 0
    for number in range(cases(3, 300)):
        stuff = {"stiffness_n_per_m": 1000.0} | NORMAL[number % 3] | FRICTION[(number // 3 + number) % 3]
        it = ROOM | {"material": stuff} if shape == "room" else make_table(shape, tmp_path, stuff)
        objects = [it | {"name": f"it {k}", "position_m": [0.004 * k, 0.0, 0.001 * k]} for k in range(count)]
        scene = load_scene({"fingertip": {"radius_m": R}, "object": objects})
        records = Engine(scene).run(random_poses(rng, cases(100, 150)))
        depth, force = records["contact.penetration"], records["contact.normal_force"]
        assert (depth >= 0.0).all(), (number, depth.min())
        assert (depth[records["contact.mode"] == 0] == 0.0).all()
        if count == 1:  # a second object may bear all of the force
            assert (depth[force > 0.0] > 0.0).all()
        touched += int((force > 0.0).sum())
    assert touched >= 20
