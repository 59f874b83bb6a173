"""Ellipsoid fingertips: contact geometry, rolling, energy and the checks of the scene file. K = 1000 N/m, no
damping."""

import re
from typing import Any

import numpy as np
import pytest
from helpers import touching
from helpers.examples import Cases
from numpy.typing import ArrayLike
from references.ellipsoid_finger import roll_ellipsoid, touching_at
from references.laws import axis_angles, stored_energy
from references.rotation import Array, matrix, multiply, quaternion
from scipy.special import ellipeinc

from softfinger.config.errors import ConfigError
from softfinger.config.load import build
from softfinger.config.schema import Scene
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.contact.fingertip import compute_radius_of_curvature
from softfinger.proxy.kernels.contact.rolling import roll
from softfinger.proxy.kernels.jit.decorators import PLAIN
from softfinger.proxy.kernels.numerics import rotations
from softfinger.proxy.kernels.shapes import closest, curvature
from softfinger.proxy.record import ROLLING
from softfinger.proxy.scene import build_scene
from softfinger.tools.accuracy.reference import compute_normal_and_curvature

pytestmark = pytest.mark.plain
K = 1000.0
AXES: model.Vec3 = (0.008, 0.006, 0.012)
TURN: model.Quaternion = tuple(float(part) for part in quaternion([0.4, -0.7, 0.3]))
SHAPES: dict[str, Any] = {
    "plane": model.Plane((0.6, 0.0, 0.8), 0.02),
    "sphere": model.Sphere(0.03, 1.0),
    "cylinder": model.Cylinder(0.02, 1.0),
}
TABLES: dict[str, Any] = {
    "plane": {"shape": "plane"},
    "sphere": {"shape": "sphere", "radius_m": 0.03, "position_m": [0.0, 0.0, -0.03]},
    "cylinder": {"shape": "cylinder", "radius_m": 0.03, "position_m": [0.0, 0.0, -0.03],
                 "orientation_wxyz": [1.0, 1.0, 0.0, 0.0]},
}  # fmt: skip
"""Objects with their highest point at the origin."""
BESIDE = {"position_m": [0.038, 0.0, 0.007]}
"""Position of a second sphere; a sphere fingertip of 10 mm at rest on the plane has a gap of 0.2 mm to it."""
STICKY = {"static": 1000.0, "kinetic": 1000.0}
GRIP = {"static": 0.6, "kinetic": 0.5}


def scene(tip: dict[str, Any], *objects: dict[str, Any], friction: dict[str, float] = GRIP, **changes: Any) -> Scene:
    """Return a scene whose type depends only on the list of shapes, since each type is compiled."""
    made_of = touching.GRIP | {"damping_ns_per_m": 0.0, "friction": friction} | changes
    tables: dict[str, Any] = {
        "fingertip": tip,
        "rolling": {"method": "montana_rk4"},
        "coupling": {"damping_ns_per_m": 0.0},
        "probe": {"velocity_time_constant_s": 0.0},
        "object": [entry | {"name": f"object {i}", "material": made_of} for i, entry in enumerate(objects)],
    }
    return build(Scene, tables, "test scene")


def minkowski_sum(shape: Any, orientation: ArrayLike, axes: model.Vec3 = AXES) -> model.MinkowskiSum:
    q = np.asarray(orientation, float)
    return model.MinkowskiSum(shape, axes, tuple(float(part) for part in q / np.linalg.norm(q)), min(axes))


def support(axes: ArrayLike, orientation: ArrayLike, n: ArrayLike) -> float:
    return float(np.linalg.norm(np.asarray(axes) * (matrix(orientation).T @ np.asarray(n))))


@pytest.mark.parametrize("name", SHAPES)
def test_gap_is_the_distance_of_the_two_bodies(name: str) -> None:
    rng, shape = np.random.default_rng(1), SHAPES[name]
    for _ in range(8):
        _, foot, n = closest(shape, tuple(rng.normal(0.0, 0.05, 3)))
        axes = tuple(float(a) for a in rng.uniform(0.003, 0.012, 3))
        q = rng.normal(size=4)
        x = np.add(foot, rng.uniform(0.002, 0.02) * np.array(n))
        minkowski = minkowski_sum(shape, q, axes)
        gap, point, normal = closest(minkowski, tuple(x))
        gap, center = gap - minkowski.radius, np.add(point, minkowski.radius * np.array(normal))
        # Centre, gap and normal are consistent, to rounding of coordinates of some centimetres.
        np.testing.assert_allclose(x - center, gap * np.array(normal), rtol=0.0, atol=1e-15)
        contact = center + matrix(q) @ touching_at(axes, q / np.linalg.norm(q), np.array(normal))
        off, _, own = closest(shape, tuple(contact))
        assert abs(off) < 1e-15 and np.dot(own, normal) == pytest.approx(1.0, abs=1e-14)
        if gap > 0.0:
            around = rng.normal(size=(2000, 3))
            skin = around / np.linalg.norm(around, axis=1)[:, None] * axes @ matrix(q).T + x
            assert min(closest(shape, tuple(p))[0] for p in skin) >= gap - 1e-15


@pytest.mark.sampled(1)
@pytest.mark.parametrize("names", [("cylinder",), ("plane", "sphere")])
def test_equal_radii_are_the_ball(names: tuple[str, ...]) -> None:
    t = np.arange(400) / 400
    x = np.stack([4e-3 * np.sin(7 * t), 3e-3 * np.sin(4 * t), 0.0095 + 1e-3 * np.sin(9 * t)], axis=1)
    q = np.stack([np.ones_like(t), 0.2 * np.sin(5 * t), 0.3 * np.sin(3 * t), 0.2 * t], axis=1)
    poses = np.hstack([x, q / np.linalg.norm(q, axis=1)[:, None]])
    objects = [TABLES[name] for name in names]
    if len(objects) > 1:
        objects[1] = objects[1] | BESIDE
    ball = Engine(scene({"radius_m": 0.01}, *objects, damping_ns_per_m=1.0)).run(poses)
    tip = {"radii_m": [0.01] * 3, "orientation_wxyz": list(TURN)}
    same = Engine(scene(tip, *objects, damping_ns_per_m=1.0)).run(poses)
    assert len(objects) == 1 or (same["contacts1.object"] >= 0).any()
    assert set(ball["contact.mode"]) == {0.0, 1.0, 2.0}
    np.testing.assert_allclose(same, ball, rtol=0.0, atol=1e-12)


def test_roundness_is_the_curvature_radius_at_the_contact_point() -> None:
    """The radius is 1 / sqrt(k1 k2), the curvatures from the second derivatives of the ellipsoid's equation."""
    rng = np.random.default_rng(2)
    form = model.EllipsoidTip(AXES, TURN)
    for _ in range(4):
        n = rng.normal(size=3)
        n /= np.linalg.norm(n)
        q = quaternion(rng.normal(size=3))
        spot = touching_at(AXES, multiply(q, TURN), n)
        _, bend = compute_normal_and_curvature(spot, model.Ellipsoid(AXES, 1.0))
        curvatures = np.linalg.eigvalsh(bend)[1:]  # the third is 0, along the normal
        radius = compute_radius_of_curvature(form, min(AXES), tuple(q), tuple(n))
        assert radius == pytest.approx(1.0 / np.sqrt(curvatures.prod()), rel=1e-12)


def end_of_roll(method: Any, shape: Any, point: Array, w: Array, ticks: int) -> tuple[Array, Array, float]:
    """Centre, normal and spin after the rotation vector `w` in `ticks` equal steps, from the orientation TURN."""
    turn = rotations.exp(tuple(w / ticks))
    n = np.array(closest(shape, tuple(point))[2])
    center, normal = tuple(point - matrix(TURN) @ touching_at(AXES, np.array(TURN), n)), tuple(n)
    spin = 0.0
    for tick in range(ticks):
        now = multiply(quaternion(w * (tick + 1) / ticks), TURN)
        out = roll(method, minkowski_sum(shape, now), min(AXES), center, normal, turn)
        center, normal, spin = out.center, out.normal, spin + out.spin
    return np.array(center), np.array(normal), spin


CASES = [
    ("plane", model.MontanaRk45(1e-12), 1, 0),
    ("sphere", model.MontanaRk45(1e-12), 1, 0),
    ("cylinder", model.MontanaRk45(1e-12), 1, 0),
    ("cylinder", model.Midpoint(), 64, 2),
    ("sphere", model.MontanaRk4(), 16, 4),
]


@pytest.mark.sampled(2)
@pytest.mark.parametrize(("name", "method", "ticks", "order"), CASES)
def test_rolling_follows_the_shape_operators_of_both_bodies(name: str, method: Any, ticks: int, order: int) -> None:
    """(W_o + W_f) p' = w x n, integrated to the eighth order, in a roll of 1.5 rad."""
    rng, shape = np.random.default_rng(3), SHAPES[name]
    for _ in range(2):
        _, foot, _ = closest(shape, tuple(rng.normal(0.0, 0.04, 3)))
        w = rng.normal(size=3)
        w *= 1.5 / np.linalg.norm(w)
        true = roll_ellipsoid(shape, AXES, TURN, foot, lambda _, w=w: w)
        assert true.apart < 1e-14  # error of the reference itself: rounding of some forty steps

        def error(ticks: int, foot: Any = foot, w: Array = w, true: Any = true) -> float:
            center, normal, spin = end_of_roll(method, shape, np.array(foot), w, ticks)
            off = np.linalg.norm(center - true.center) / AXES[0]
            return float(max(off, np.linalg.norm(normal - true.normal), abs(spin - true.spin)))

        if order == 0:
            assert error(ticks) < 1e-10  # sub-steps to 1e-12, some tens of them
        else:
            coarse, fine = error(ticks), error(2 * ticks)
            assert fine < 1e-3 and np.log2(coarse / fine) == pytest.approx(order, abs=0.35)


def test_a_spheroid_rolls_on_its_equator_like_a_wheel() -> None:
    """Rolled by theta, the contact moves by a theta at constant height, without tangential force and torque."""
    a, theta = 0.008, np.linspace(0.0, 3.0, 300)
    x = np.stack([a * theta, 0.0 * theta, 0.0 * theta + a - 1e-3], axis=1)
    q = np.stack([np.cos(theta / 2), 0.0 * theta, np.sin(theta / 2), 0.0 * theta], axis=1)
    rows = Engine(scene({"radii_m": [a, 0.005, a]}, TABLES["plane"])).run(np.hstack([x, q]))
    np.testing.assert_allclose(rows["contact.point"][:, 0], a * theta, rtol=0.0, atol=1e-14)
    np.testing.assert_allclose(rows["proxy.position"][:, 2], a, rtol=0.0, atol=1e-15)
    np.testing.assert_allclose(rows["force"] - [0.0, 0.0, 1.0], 0.0, rtol=0.0, atol=1e-11)
    np.testing.assert_allclose(rows["torque"], 0.0, rtol=0.0, atol=1e-13)
    np.testing.assert_allclose(rows["contact.rolled"], theta, rtol=0.0, atol=1e-12)
    spot = np.stack([a * np.sin(theta), 0.0 * theta, -a * np.cos(theta)], axis=1)
    np.testing.assert_allclose(rows["contact.finger_point"], spot, rtol=0.0, atol=1e-15)


def test_contact_travels_an_elliptic_arc_in_a_line_roll() -> None:
    """About axis b, an elliptic integral. The force's moment is the derivative of the springs' energy."""
    a, _, c = AXES
    theta = np.linspace(0.0, 1.2, 601)
    x = np.tile([0.0, 0.0, 0.0075], (601, 1))
    q = np.stack([np.cos(theta / 2), 0.0 * theta, np.sin(theta / 2), 0.0 * theta], axis=1)
    rows = Engine(scene({"radii_m": list(AXES)}, TABLES["plane"], friction=STICKY)).run(np.hstack([x, q]))
    assert set(rows["contact.mode"]) == {ROLLING}
    height = np.hypot(a * np.sin(theta), c * np.cos(theta))
    # The contact point is (a sin u, -c cos u) with tan u = a / c tan theta, measured from the lowest point.
    u = np.arctan2(a * np.sin(theta), c * np.cos(theta))
    arc = a * ellipeinc(u, 1.0 - (c / a) ** 2)
    # 600 Runge-Kutta steps of 2 mrad leave an error of some 1e-14.
    np.testing.assert_allclose(rows["contact.point"][:, 0], arc, rtol=0.0, atol=1e-12)
    load = K * (height - x[:, 2])
    np.testing.assert_allclose(rows["contact.normal_force"], load, rtol=1e-12)
    # The centre is ahead of the contact by the lever arm, which reduces the stretch of the spring.
    aside = arc - (a * a - c * c) * np.sin(theta) * np.cos(theta) / height
    np.testing.assert_allclose(rows["force"][:, 0], K * aside, rtol=0.0, atol=1e-9)
    # dh / dtheta = (a^2 - c^2) sin cos / h, and the centre moves by h dtheta.
    moment = -load * (a * a - c * c) * np.sin(theta) * np.cos(theta) / height - K * aside * height
    np.testing.assert_allclose(rows["torque"][:, 1], moment, rtol=0.0, atol=1e-11)


def test_rolling_round_a_parallel_turns_the_finger() -> None:
    """Holonomy: a roll round a parallel of a spheroid draws a circle of radius rho / cos beta on the plane. The finger
    turns by 2 pi cos beta about the normal: 2 pi less the area enclosed by the normals (Gauss and Bonnet)."""
    a, c, beta = 0.008, 0.011, 0.6
    height = np.hypot(a * np.sin(beta), c * np.cos(beta))
    rho = a * a * np.sin(beta) / height
    paths = []
    for ticks in (250, 500):
        s = np.linspace(0.0, 2.0 * np.pi, ticks + 1)
        poses = []
        for angle in s:
            about = multiply(quaternion([0.0, beta, 0.0]), quaternion([0.0, 0.0, -angle]))
            about = multiply(quaternion([0.0, 0.0, np.cos(beta) * angle]), about)
            poses.append(np.concatenate([[0.0, 0.0, height - 1e-3], about]))
        made = scene({"radii_m": [a, a, c]}, TABLES["plane"], friction=STICKY)
        points = Engine(made).run(np.array(poses))["contact.point"]
        paths.append((points - points[0])[:: ticks // 250])
    turned = np.cos(beta) * np.linspace(0.0, 2.0 * np.pi, 251)
    circle = rho / np.cos(beta) * np.stack([np.cos(turned) - 1.0, np.sin(turned), 0.0 * turned], axis=1)
    # The rate is constant within a tick, an error of second order. Its extrapolation leaves one of fourth order: (2 pi
    # / 250)^4 of a circle of 7 mm.
    np.testing.assert_allclose(paths[1], circle, rtol=0.0, atol=4e-7)
    np.testing.assert_allclose((4.0 * paths[1] - paths[0]) / 3.0, circle, rtol=0.0, atol=3e-9)


def work(rows: Array) -> Array:
    """Work (n,) J of the hand up to each tick, by the trapezoidal rule, of second order in the step."""
    moved = np.diff(rows["probe.position"], axis=0)
    turned = axis_angles(rows["probe.orientation"])
    force, torque = rows["force"], rows["torque"]
    mean = 0.5 * (force[1:] + force[:-1]), 0.5 * (torque[1:] + torque[:-1])
    return np.concatenate([[0.0], -np.cumsum(np.sum(mean[0] * moved, axis=1) + np.sum(mean[1] * turned, axis=1))])


def closed_path(ticks: int, lowest: float) -> Array:
    t = 2.0 * np.pi * np.arange(ticks + 1) / ticks
    s = np.sin(t)
    x = np.stack([8e-4 * s, 5e-4 * np.sin(2 * t), lowest - 4e-4 * s * s], axis=1)
    q = [quaternion([0.25 * np.sin(t_), 0.2 * (1 - np.cos(t_)), 0.3 * np.sin(2 * t_)]) for t_ in t]
    return np.hstack([x, q])


@pytest.mark.sampled(1)
@pytest.mark.scaled
@pytest.mark.parametrize("name", ["plane", "cylinder"])
def test_sticking_contact_returns_the_work_of_the_hand(cases: Cases, name: str) -> None:
    tip = {"radii_m": list(AXES), "orientation_wxyz": list(TURN)}
    lowest = support(AXES, TURN, [0.0, 0.0, 1.0]) - 1.2e-3
    torsion = {"stiffness_nm_per_rad": 0.05, "friction_length_m": 1.0}
    engine, off = Engine(scene(tip, TABLES[name], friction=STICKY, torsion=torsion)), []
    few = cases(300, 1000)
    for ticks in (few, 2 * few):
        engine.reset()
        rows = engine.run(closed_path(ticks, lowest))
        assert set(rows["contact.mode"]) == {ROLLING}
        stored = stored_energy(rows)
        off.append(np.abs(work(rows) - (stored - stored[0])).max())
    assert off[1] < 1e-4 * (1000 / few) ** 2 * stored.max() and off[0] / off[1] == pytest.approx(4.0, abs=0.5)


@pytest.mark.scaled
def test_between_two_bodies_no_cycle_gains_energy(cases: Cases) -> None:
    tip = {"radii_m": list(AXES), "orientation_wxyz": list(TURN)}
    lowest = support(AXES, TURN, [0.0, 0.0, 1.0]) - 1.2e-3
    ticks = cases(200, 1000)
    once = closed_path(ticks, lowest)
    rows = Engine(scene(tip, TABLES["plane"], TABLES["sphere"] | BESIDE)).run(np.vstack([once, *[once[1:]] * 3]))
    shared = rows["contacts1.object"] >= 0
    assert shared.any() and not shared.all()
    assert (np.diff(work(rows)[::ticks])[1:] > 0.0).all()


TIP: dict[str, Any] = {"radii_m": list(AXES)}
FAULTS: list[tuple[dict[str, Any], dict[str, Any], str]] = [
    ({}, {}, "fingertip.radius_m: is missing: give a number from 1e-05 to 1000 m, such as radius_m = 0.01, or"),
    (TIP | {"radius_m": 0.01}, {}, "fingertip.radius_m = 0.01: describes a sphere, and radii_m an ellipsoid"),
    ({"radius_m": 0.01, "orientation_wxyz": [1, 0, 0, 0]}, {}, "to an ellipsoid, but the fingertip is a sphere"),
    (TIP | {"orientation_wxyz": [0, 0, 0, 0]}, {}, "fingertip.orientation_wxyz = [0.0, 0.0, 0.0, 0.0]: all zero is no"),
    ({"radii_m": [0.001, 0.011, 0.011]}, {}, "fingertip.radii_m = [0.001, 0.011, 0.011]: the longest must be"),
    ({"radii_m": [0.01, 0.01]}, {}, "fingertip.radii_m = [0.01, 0.01]: must be a list of 3 numbers"),
    ({"radii_m": [0.01, 0.01, 0.0]}, {}, "fingertip.radii_m[2] = 0.0: must be a number from 1e-05 to 1000 m"),
    (TIP, {"rolling": {"method": "euler_zxz"}}, "rolling.method = 'euler_zxz': needs a spherical fingertip"),
    (TIP, {"rolling": {"method": "rotation_vector"}}, "use midpoint, or montana_rk4 for long ticks"),
    (TIP, {"shape": "capsule", "radius_m": 0.05, "length_m": 0.1}, "object[0].shape = 'capsule': cannot be touch"),
    (TIP, {"shape": "sphere", "inside": True, "radius_m": 0.05}, "a sphere or infinite cylinder touched from outside"),
    (TIP, {"shape": "cylinder", "radius_m": 0.05, "length_m": 0.1}, "object[0].shape"),
    (TIP, {"shape": "box", "size_m": [0.1, 0.1, 0.1]}, "object[0].shape"),
    (TIP, {"shape": "mesh", "file": "part.ply"}, "object[0].shape = 'mesh'"),
    (TIP, {"shape": "box", "size_m": [0.1, 0.1, 0.02], "inside": True}, "must be above 0.024 m, the diameter"),
]


@pytest.mark.parametrize(("tip", "changes", "message"), FAULTS)
def test_unsupported_ellipsoid_scenes_are_refused(tip: dict[str, Any], changes: dict[str, Any], message: str) -> None:
    shape = {key: value for key, value in changes.items() if key != "rolling"} or {"shape": "plane"}
    made_of = {"stiffness_n_per_m": K, "friction": GRIP}
    tables: dict[str, Any] = {"object": [shape | {"name": "thing", "material": made_of}]}
    if "rolling" in changes:
        tables["rolling"] = changes["rolling"]
    with pytest.raises(ConfigError, match=re.escape(message)):
        build(Scene, tables | {"fingertip": tip}, "test scene")
    message = message.replace("fingertip.", "finger[0].")
    with pytest.raises(ConfigError, match=re.escape(message)):
        build(Scene, tables | {"finger": [{"name": "index"} | tip]}, "test scene")


def test_a_hollow_box_becomes_six_planes() -> None:
    box = {"shape": "box", "size_m": [0.1, 0.1, 0.1], "inside": True}
    entries = build_scene(scene({"radii_m": list(AXES)}, box)).objects.entries
    assert [type(entry.shape.sizes[0]) for entry in entries.trees] == [model.Plane] * 6


@pytest.mark.skipif(not PLAIN, reason="calls kernels from Python, which compiled ones do not allow")
@pytest.mark.parametrize("kind", SHAPES)
def test_curvature_is_the_derivative_of_the_normal(kind: str) -> None:
    """Along both principal directions, the normal's central difference over 2 um equals the curvature. The difference
    leaves 1e-6 of third derivatives and 1e-10 of rounding, over 1e-6 m."""
    random, step, behind = np.random.default_rng(8), 1e-6, 0.009
    for _ in range(10):
        q = random.normal(size=4)
        minkowski = model.MinkowskiSum(SHAPES[kind], AXES, tuple((q / np.linalg.norm(q)).tolist()), behind)
        x = random.normal(size=3)
        _, point, n = closest(minkowski, tuple((0.05 * x / np.linalg.norm(x)).tolist()))
        center = np.array(point) + behind * np.array(n)
        k1, k2, first = curvature(minkowski, behind, point, n)
        assert kind == "plane" or k1 > 1.0
        for along, k in ((np.array(first), k1), (np.cross(n, first), k2)):
            ahead, back = (np.array(closest(minkowski, tuple((center + h * along).tolist()))[2]) for h in (step, -step))
            np.testing.assert_allclose((ahead - back) / (2.0 * step), k * along, atol=1e-3)
