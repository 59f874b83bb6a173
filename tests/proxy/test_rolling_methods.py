"""Rolling methods compared with eighth-order integration: accuracy, order, special rotations, drift in many steps.

The paper's Euler decomposition on z = 0, r = 10 mm, is compared with the published differences.
"""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from conftest import paper_scene
from helpers import meshes
from helpers.examples import Cases
from helpers.hostile_maps import part
from helpers.touching import R, engine, make_object, visit, write_part
from references import rolling_cases
from references.hand import Array
from references.paper import published
from references.rolling_cases import METHODS, RADIUS, SHAPES, pairs, rolled_by, rotation, touching
from references.rolling_reference import rolled_path, rolling_equation, zxz_roll, zyx_roll
from references.rotation import multiply, quaternion, rodrigues
from scipy.spatial.transform import Rotation

from softfinger.config.schema import Scene
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.contact.rolling import roll
from softfinger.proxy.kernels.numerics import rotations
from softfinger.proxy.kernels.shapes import closest
from softfinger.proxy.record import AT, ROLLING
from softfinger.proxy.scene import build_scene
from softfinger.tools.accuracy.reference import roll_path

pytestmark = pytest.mark.plain

CLOSED = [name for name, shape in SHAPES.items() if rolling_cases.has_closed_form(shape)]


def integrated(shape: Any, radius: float, center: Any, normal: Any, w: Any) -> tuple[Any, Any, float]:
    """Return centre (3,) m, normal (3,) and spin (rad) after one second at the rate `w`."""
    points, normals, spins = roll_path(shape, radius, center, normal, lambda _: w, 1.0).at(np.array([1.0]))
    return points[0] + radius * normals[0], normals[0], float(spins[0])


@pytest.mark.sampled(5)
@pytest.mark.parametrize("name", CLOSED)
def test_rotation_vector_is_exact(name: str) -> None:
    rng, shape = np.random.default_rng(11), SHAPES[name]
    worst = 0.0
    for _ in range(6):
        center, normal = touching(shape, rng)
        w = rotation(rng)
        out = rolled_by(METHODS["rotation_vector"], shape, center, normal, w)
        end, n, spin = integrated(shape, RADIUS, center, normal, w)
        worst = max(worst, np.abs(np.array(out.center) - end).max(), RADIUS * np.abs(np.array(out.normal) - n).max())
        worst = max(worst, RADIUS * abs(out.spin - spin))
    # Rounding, the reference's error of 1e-13, and 1e-12 rad of integrated spin across the rim of a cylinder.
    assert worst < 1e-13


@pytest.mark.parametrize("begins", ["barrel", "end"])
def test_rotation_vector_is_exact_from_barrel_and_end_of_a_cylinder(begins: str) -> None:
    rng, shape, crossed = np.random.default_rng(14), SHAPES["capped cylinder"], 0
    out_of = shape.radius + RADIUS, shape.half_length + RADIUS
    for _ in range(10):
        if begins == "barrel":
            center, normal = (out_of[0], 0.0, rng.uniform(-1.0, 1.0) * shape.half_length), (1.0, 0.0, 0.0)
        else:
            center, normal = (rng.uniform(-1.0, 1.0) * shape.radius, 0.0, out_of[1]), (0.0, 0.0, 1.0)
        w = rotation(rng)
        out = rolled_by(METHODS["rotation_vector"], shape, center, normal, w)
        end, n, spin = integrated(shape, RADIUS, center, normal, w)
        leaves = abs(out.normal[2] - normal[2]) > 1e-9  # the normal's z component changes only on the rim
        past = leaves and abs(out.normal[2]) in (0.0, 1.0)
        crossed += leaves
        # As above; but a step that ends beyond the rim contains a jump of the curvature, with an error of 3e-9 r.
        most = 1e-8 * RADIUS if past else 1e-13
        assert max(np.abs(np.array(out.center) - end).max(), RADIUS * abs(out.spin - spin)) < most
        assert RADIUS * np.abs(np.array(out.normal) - n).max() < most
    assert crossed


@pytest.mark.parametrize("scale", [1e-5, 1.0, 1e3])
def test_rotation_vector_at_all_sizes(scale: float) -> None:
    rng = np.random.default_rng(12)
    for shape in (model.Sphere(3.0 * scale, 1.0), model.Sphere(3.0 * scale, -1.0), model.Cylinder(2.0 * scale, 1.0)):
        x = tuple(float(v) for v in rng.normal(0, 0.1 * scale, 3))
        _, point, n = closest(shape, x)
        center = tuple(p + scale * c for p, c in zip(point, n, strict=True))
        w = rotation(rng)
        out = roll(METHODS["rotation_vector"], shape, scale, center, n, rotations.exp(w))
        # The reference integrates in units of the fingertip radius, for which its tolerances are meant.
        unit = shape._replace(radius=shape.radius / scale)
        end, _, _ = integrated(unit, 1.0, np.array(center) / scale, n, w)
        assert np.abs(np.array(out.center) / scale - end).max() < 1e-11


@pytest.mark.sampled(4)
@pytest.mark.parametrize("name", SHAPES)
def test_step_control_reaches_its_tolerance(name: str) -> None:
    rng, shape = np.random.default_rng(13), SHAPES[name]
    for _ in range(2):
        center, normal = touching(shape, rng)
        w = rotation(rng)
        out = rolled_by(METHODS["montana_rk45"], shape, center, normal, w)
        end, _, spin = integrated(shape, RADIUS, center, normal, w)
        # 1e-10 of the radius; the error estimate is rougher at jumps of the curvature and does not cover the spin.
        assert np.abs(np.array(out.center) - end).max() < 1e-12
        assert abs(out.spin - spin) < (1e-9 if name in rolling_cases.PIECED else 1e-11)


def errors(method: Any, shape: Any, ticks: list[int], seed: int) -> list[float]:
    """Distances (m) from the integrated end point of a path of 1.5 rad, for each number of ticks."""
    rng = np.random.default_rng(seed)
    center, normal = touching(shape, rng)
    w = rotation(rng, 1.5, 1.5)
    end, _, _ = integrated(shape, RADIUS, center, normal, w)
    ends = [np.array(rolled_by(method, shape, center, normal, w, n).center) for n in ticks]
    return [float(np.linalg.norm(point - end)) for point in ends]


@pytest.mark.parametrize(
    ("method", "name", "order"),
    [
        *(("montana_rk4", name, 4.0) for name in ("ellipsoid", "torus")),
        *(("midpoint", name, 2.0) for name in ("ellipsoid", "torus")),
        ("euler_zxz", "plane", 2.0),
        *(("euler_zxz", name, 1.0) for name in ("ellipsoid", "torus", "sphere")),
        *(("euler_zyx", name, 1.0) for name in ("plane", "ellipsoid")),
    ],
)
def test_order_of_convergence(method: str, name: str, order: float) -> None:
    distances = errors(METHODS[method], rolling_cases.SMOOTH[name], [16, 32, 64], seed=21)
    for coarse, fine in pairwise(distances):
        # At these ticks the next order contributes two per cent.
        assert np.log2(coarse / fine) == pytest.approx(order, abs=0.05)
    assert distances[-1] > 1e-14  # far above rounding, so that the ratios mean something


@pytest.mark.parametrize("name", ["plane", "sphere", "hollow sphere"])
def test_euler_zxz_is_exact_without_spin(name: str) -> None:
    rng, shape = np.random.default_rng(14), SHAPES[name]
    for _ in range(20):
        center, normal = touching(shape, rng)
        tangent = np.cross(normal, rng.normal(size=3))
        w = tangent / np.linalg.norm(tangent) * rng.uniform(0, 3)
        out = rolled_by(METHODS["euler_zxz"], shape, center, normal, w)
        exact = rolled_by(METHODS["rotation_vector"], shape, center, normal, w)
        # Rounding of lengths of 0.1 m.
        assert out.center == pytest.approx(exact.center, abs=1e-15)
        assert out.motion == pytest.approx(exact.motion, abs=1e-15)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("method", METHODS)
def test_rolling_over_the_edge_of_a_box(method: str) -> None:
    box, center, normal = SHAPES["box"], (0.0, 0.0148, 0.02), (0.0, 0.0, 1.0)
    turn = rotations.exp((-1e-3, 0.0, 0.0))
    angles = []
    for _ in range(1700):
        out = roll(METHODS[method], box, RADIUS, center, normal, turn)
        center, normal = out.center, out.normal
        gap, _, _ = closest(box, center)
        assert gap == pytest.approx(RADIUS, abs=1e-17)
        angles.append(np.arctan2(normal[1], normal[2]))
    # 0.02 rad on the face, pi / 2 on the edge, the remainder down the side.
    assert np.diff(angles).min() >= 0.0 and np.diff(angles).max() < 1.1e-3
    assert normal == (0.0, 1.0, 0.0)
    # Methods with fixed steps end a straight segment within one tick of the edge, 10 um; the others meet it exactly.
    down = 0.01 - RADIUS * (1.7 - 0.02 - np.pi / 2)
    assert center[2] == pytest.approx(down, abs=1e-12 if method in ("rotation_vector", "montana_rk45") else 1e-5)


@pytest.mark.parametrize(("method", "name"), pairs())
def test_tiny_rotation_rolls_by_its_tangential_part(method: str, name: str) -> None:
    rng, shape = np.random.default_rng(16), SHAPES[name]
    center, normal = touching(shape, rng)
    w = rotation(rng, 1e-12, 1e-12)
    out = roll(METHODS[method], shape, RADIUS, center, normal, rotations.exp(w))
    # The normal turns by about 1e-12 rad too; the other errors are rounding.
    assert np.array(out.motion) == pytest.approx(RADIUS * np.cross(w, normal), abs=1e-10 * RADIUS * 1e-12)
    assert out.spin == pytest.approx(np.dot(w, normal), abs=1e-23)


@pytest.mark.parametrize(("method", "name"), pairs())
def test_no_rotation_moves_nothing_and_pure_spin_does_not_roll(method: str, name: str) -> None:
    center, normal = touching(SHAPES[name], np.random.default_rng(17))
    out = roll(METHODS[method], SHAPES[name], RADIUS, center, normal, (1.0, 0.0, 0.0, 0.0))
    assert (out.motion, out.theta, out.spin) == ((0.0, 0.0, 0.0), 0.0, 0.0)
    assert out.center == pytest.approx(center, abs=1e-16)
    for angle in (1e-3, np.pi / 2, 3.0, -3.0):
        turn = rotations.exp(tuple(angle * float(n) for n in normal))
        out = roll(METHODS[method], SHAPES[name], RADIUS, center, normal, turn)
        assert out.spin == pytest.approx(angle, abs=1e-12) and out.theta < 1e-12
        assert out.center == pytest.approx(center, abs=1e-14)


@pytest.mark.parametrize(("method", "name"), pairs())
def test_rotations_near_half_a_turn(method: str, name: str) -> None:
    rng, shape = np.random.default_rng(18), SHAPES[name]
    for angle in (np.pi - 1e-9, np.pi, np.pi * (1 - 1e-16)):
        center, normal = touching(shape, rng)
        turn = rotations.relative(rotations.exp(rotation(rng, angle, angle)), (1.0, 0.0, 0.0, 0.0))
        out = roll(METHODS[method], shape, RADIUS, center, normal, turn)
        assert np.isfinite([*out.center, *out.motion, out.theta, out.spin]).all()
        gap, _, _ = closest(shape, out.center)
        assert gap == pytest.approx(RADIUS, abs=1e-15)
        assert out.theta == pytest.approx(np.linalg.norm(out.motion) / RADIUS, abs=1e-12)
        assert np.dot(out.motion, out.normal) == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize("method", METHODS)
def test_a_scene_selects_the_method(method: str) -> None:
    built = build_scene(paper_scene(rolling={"method": method}))
    assert type(built.rolling) is type(METHODS[method]) and built.fingers[0].torque_stiffness == 1000.0
    tolerance = {"tolerance": 1e-6} if method == "montana_rk45" else {}
    less = build_scene(paper_scene(rolling={"method": method, "torque_stiffness_n_per_m": 250.0, **tolerance}))
    assert less.rolling == type(built.rolling)(*tolerance.values())
    assert less.fingers[0].torque_stiffness == 250.0


@pytest.mark.sampled(12)
@pytest.mark.scaled
@pytest.mark.parametrize(("method", "name"), pairs())
def test_contact_does_not_drift_off_the_object(cases: Cases, method: str, name: str) -> None:
    center, normal = touching(SHAPES[name], np.random.default_rng(31))
    # A drift off a smooth object is more than 1e-15 m per step. An ellipsoid's closest point takes long.
    ticks = cases(1000, 10_000_000 if name in ("sphere", "box") else 200_000)
    off, stretched, _ = rolling_cases.roll_long(
        METHODS[method], SHAPES[name], RADIUS, center, normal, (6e-4, -3e-4, 4e-4), ticks
    )
    # On a plane the path leads far away, and rounding grows with the distance: 1e-16 of at most 10 m.
    assert off < 1e-12
    assert stretched < 1e-14


HIGH_FRICTION = {"friction": {"static": 1000.0, "kinetic": 1000.0}}


def engine_path(scene: Scene, follow: Array, turned: Array, dt: float, depth: float = 0.001) -> Array:
    """Contact points (n, 3) m of a probe with its centre above `follow` (n, 3), pressed in by `depth`."""
    records = Engine(scene, 1.0 / dt).run(np.hstack([follow + np.array([0.0, 0.0, R - depth]), turned]), dt)
    assert (records["contact.mode"] == ROLLING).all()
    at = AT.contact_point
    return records[:, at : at + 3]


def paper_step() -> Array:
    table = published()
    return np.array([table["delta_psi"], table["delta_theta"], table["delta_phi"]])


@pytest.mark.parametrize("is_fixed", [False, True])
def test_paper_experiment_along_a_line(is_fixed: bool) -> None:
    """With constant world rates, the decomposition deviates by 2.1 and 3.1 um from a line to (20, -30) mm. The engine
    computes the path of eqs. 5-7 on matrices, whether the probe follows or is at a fixed position."""
    table, w = published(), paper_step()
    dt, n = table["sampling_time"], round(table["duration"] / table["sampling_time"])
    times = np.linspace(0, table["duration"], n + 1)
    exact, _ = rolling_equation(lambda _: w / dt, table["radius"], times)
    assert exact[-1] == pytest.approx([0.020, -0.030, 0.0], abs=1e-12)

    by_hand = rolled_path([rodrigues(w)] * n, table["radius"])
    largest = np.abs(by_hand - exact).max(axis=0)
    # Known to four decimals of a millimetre.
    assert largest == pytest.approx([0.0021e-3, 0.0031e-3, 0.0], abs=0.5e-7)
    # Below the paper's values, which are for another interpretation of the motion.
    assert largest[0] < table["largest_difference_x"] and largest[1] < table["largest_difference_y"]

    follow = np.zeros_like(exact) if is_fixed else exact
    path = engine_path(paper_scene(material=HIGH_FRICTION), follow, quaternion(np.outer(np.arange(n + 1), w)), dt)
    # 1e-13 m: rounding of 100 steps and of the arctangents; the requirement is 1e-5 mm.
    assert path == pytest.approx(by_hand, abs=1e-13)


def test_paper_experiment_along_an_arc() -> None:
    """With constant rates in a contact frame that turns by the spin of each decomposed step: 0.004 mm, as printed.
    Turned by 0.05 rad per step it would be 0.00003 mm."""
    table, w = published(), paper_step()
    n = round(table["duration"] / table["sampling_time"])
    normal = np.array([0.0, 0.0, 1.0])

    def turned(angle: float, v: Array) -> Array:
        return rodrigues(angle * normal) @ v

    exact, _ = rolling_equation(lambda k: turned(k * w[2], w), table["radius"], np.linspace(0.0, n, n + 1))
    assert exact[-1] == pytest.approx([0.462e-3, 8.619e-3, 0.0], abs=0.5e-6)
    roll, _, spin = zxz_roll(rodrigues(w), normal, "phi")
    steps = [table["radius"] * turned(k * spin, np.cross(roll, normal)) for k in range(n)]
    largest = np.abs(np.vstack([np.zeros(3), np.cumsum(steps, axis=0)]) - exact).max(axis=0)
    # Printed to 0.001 mm: half a unit of the last digit.
    assert largest[0] == pytest.approx(table["largest_difference_x"], abs=0.5e-6)
    assert largest[1] == pytest.approx(table["largest_difference_y"], abs=0.5e-6)


def test_varying_rate_converges_with_the_square_of_the_step() -> None:
    def rate(t: float) -> Array:
        return np.array([3 * np.cos(2 * t), 2 * np.sin(5 * t), 4 + 2 * np.sin(3 * t)])

    errors = []
    for n in (125, 250, 500):
        exact, matrices = rolling_equation(rate, R, np.linspace(0, 1, n + 1))
        turned = np.roll(Rotation.from_matrix(matrices).as_quat(), 1, axis=1)  # scipy has w last
        path = engine_path(paper_scene(material=HIGH_FRICTION), exact, turned, 1 / n)
        errors.append(np.abs(path - exact).max())
    assert errors[-1] < 1e-6
    for coarse, fine in pairwise(errors):
        assert 3.5 < coarse / fine < 4.5


@pytest.mark.parametrize("method", ["euler_zxz", "euler_zyx", "rotation_vector"])
def test_a_step_of_the_experiment_has_the_angles_of_its_matrix(method: str) -> None:
    """tests/tools/test_accuracy.py compares the paths of these steps with the published differences."""
    w, normal = paper_step(), np.array([0.0, 0.0, 1.0])
    plane, turn = model.Plane((0.0, 0.0, 1.0), 0.0), rotations.exp(tuple(w.tolist()))
    out = roll(METHODS[method], plane, R, (0.0, 0.0, R), (0.0, 0.0, 1.0), turn)
    axis, spin = w, w[2]
    if method != "rotation_vector":
        axis, _, spin = (zyx_roll if method == "euler_zyx" else zxz_roll)(rodrigues(w), normal)
    assert np.array(out.motion) == pytest.approx(R * np.cross(axis, normal), abs=1e-15)
    assert out.spin == pytest.approx(spin, abs=1e-15)


BALL, PILLAR, BOWL = 0.05, 0.03, 0.04
"""Radii, m."""
DEPTH, TURN, DESCENT = 1e-3, 0.5, 10
BODIES = {
    "ball": (make_object("body", "sphere", radius_m=BALL, position_m=[0.0, 0.0, BALL]), (R - BALL) / (R + BALL)),
    "pillar": (make_object("body", "cylinder", radius_m=PILLAR), 0.0),
    "pipe": (make_object("body", "cylinder", radius_m=BOWL, inside=True), 0.0),
}
"""Object, and the vertical component of its normal at the fingertip."""
DISTANCES = {"ball": np.sqrt((BALL + R) ** 2 - (R - BALL) ** 2), "pillar": PILLAR + R, "pipe": BOWL - R}
"""Distances of the centre from the z axis, m."""


def deflections(body, distance, height, outward, ticks):
    """Difference (n,) m of a hand's force from that of two unwound springs, over the stiffness, at `distance` m from
    the z axis; the object's normal has this `height`, and points `outward` (+1) or inwards (-1)."""
    angles = np.linspace(0.0, TURN, ticks)
    radial = np.stack([np.cos(angles), np.sin(angles), 0.0 * angles], axis=1)
    up = np.array([0.0, 0.0, 1.0])
    normals = outward * np.sqrt(1.0 - height**2) * radial + height * up
    centers = distance * radial + R * up
    axes = normals - up
    velocities = distance * np.cross(up, radial)
    rolls = np.cross(axes, up)
    rates = (np.einsum("ij,ij->i", velocities, rolls) / (R * np.einsum("ij,ij->i", rolls, rolls)))[:, None] * axes
    poses = np.empty((ticks, 7))
    poses[:, :3] = centers - DEPTH * normals - DEPTH * up
    poses[0, 3:] = (1.0, 0.0, 0.0, 0.0)
    for tick in range(1, ticks):
        turn = quaternion(0.5 * (rates[tick - 1] + rates[tick]) * TURN / (ticks - 1))
        poses[tick, 3:] = multiply(turn, poses[tick - 1, 3:])
    above = np.linspace(1.2 * DEPTH, 0.0, DESCENT)[:, None] * (normals[0] + up)
    points = np.concatenate([poses[0, :3] + above, poses[1:, :3]])
    orientations = np.concatenate([np.tile(poses[0, 3:], (DESCENT, 1)), poses[1:, 3:]])
    records = visit(engine(body, make_object("floor", "plane")), points, orientations)[DESCENT:]
    expected = 1000.0 * DEPTH * (normals[1:] + up)
    return np.linalg.norm(records[:, AT.force : AT.force + 3] - expected, axis=1) / 1000.0


def check_second_order(*path):
    """The path in a tick is straight: half the tick divides the error by four."""
    long, short = (deflections(*path, ticks).max() for ticks in (101, 201))
    assert short < 1e-7 and short < 0.3 * long + 1e-9


@pytest.mark.parametrize("shape", BODIES)
def test_rolling_on_two_objects_deflects_nothing(shape):
    """Wound up by the rotation of the other contact's normal, it would deflect by a part of DEPTH x TURN = 500 um."""
    body, height = BODIES[shape]
    check_second_order(body, DISTANCES[shape], height, -1.0 if shape == "pipe" else 1.0)


def test_rolling_on_a_heightmap_and_a_floor_deflects_nothing(tmp_path):
    """A ball half sunk in the floor, as a height map. Without its curvature, 400 um would remain on any pitch."""
    pitch, sunk, rim = 0.5e-3, 0.025, 0.046
    across = pitch * (np.arange(200) - 99.5)
    squares = across[:, None] ** 2 + across**2
    heights = np.sqrt(np.maximum(BALL**2 - squares, BALL**2 - rim**2)) - sunk
    height = (R + sunk) / (R + BALL)
    check_second_order(part(tmp_path, heights, pitch), np.sqrt((BALL + R) ** 2 - (R + sunk) ** 2), height, 1.0)


def test_rolling_on_a_mesh_and_a_floor_converges_to_the_ball(tmp_path):
    """Without the rotation of the normal round edges, 380 um would remain on any mesh."""
    _, height = BODIES["ball"]
    errors = []
    for frequency in (16, 32):
        file = write_part(tmp_path, *meshes.geodesic(frequency, BALL), name=f"{frequency}.ply")
        body = make_object("body", "mesh", file=file, position_m=[0.0, 0.0, BALL])
        errors.append(deflections(body, DISTANCES["ball"], height, 1.0, 501).max())
    assert errors[1] < 0.5 * errors[0] and errors[1] < 30e-6
