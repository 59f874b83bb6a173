"""Montana's equations as published, with charts and contact angle, against the kinematics without coordinates."""

from typing import Any

import numpy as np
import pytest
from references.rolling_cases import METHODS, RADIUS, rolled_by
from references.rotation import rodrigues

from softfinger.proxy.kernels import model
from softfinger.tools.accuracy import montana
from softfinger.tools.accuracy.reference import compute_normal_and_curvature, roll_path

pytestmark = pytest.mark.plain

SHAPES: dict[str, Any] = {
    "plane": model.Plane((0.6, 0.0, -0.8), 0.01),
    "sphere": model.Sphere(0.05, 1.0),
    "hollow sphere": model.Sphere(0.05, -1.0),
    "cylinder": model.Cylinder(0.03, 1.0),
    "hollow cylinder": model.Cylinder(0.03, -1.0),
    "torus": model.Torus(0.05, 0.02, 1.0),
    "hollow torus": model.Torus(0.05, 0.02, -1.0),
    "spheroid": model.Ellipsoid((0.05, 0.05, 0.02), 1.0),
    "hollow spheroid": model.Ellipsoid((0.05, 0.05, 0.04), -1.0),
}
# On the equators of the charts and off them; far enough from the poles for every path below.
STARTS = [(0.3, 0.2), (-1.2, -0.5), (2.5, 0.0)]


def scaled(name: str, u: float, v: float) -> tuple[float, float]:
    return (0.02 * u, 0.02 * v) if name == "plane" else (u, 0.02 * v if "cylinder" in name else v)


def start(shape: Any, u: float, v: float, psi: float) -> montana.Coordinates:
    return montana.Coordinates(0.4, -0.3, u, v, psi)


def contact(shape: Any, at: montana.Coordinates) -> tuple[Any, Any]:
    """Centre (3,) m of the fingertip and unit normal (3,)."""
    here = montana.compute_chart(shape, at.u_o, at.v_o)
    return np.array(here.point) + RADIUS * np.array(here.z), np.array(here.z)


def orientation(shape: Any, at: montana.Coordinates) -> Any:
    """The fingertip's orientation (3, 3) that the five coordinates imply."""
    on_finger = montana.compute_chart(model.Sphere(RADIUS, 1.0), at.u_f, at.v_f)
    in_finger = np.column_stack([on_finger.x, on_finger.y, on_finger.z])
    in_object = np.column_stack(montana.compute_finger_axes(montana.compute_chart(shape, at.u_o, at.v_o), at.psi))
    return in_object @ in_finger.T


@pytest.mark.parametrize("name", SHAPES)
def test_gauss_frame_against_differences(name: str) -> None:
    shape, h = SHAPES[name], 1e-5
    for u, v in STARTS:
        u, v = scaled(name, u, v)
        here = montana.compute_chart(shape, u, v)
        frame = np.column_stack([here.x, here.y, here.z])
        assert frame.T @ frame == pytest.approx(np.eye(3), abs=1e-15)
        assert np.cross(here.x, here.y) == pytest.approx(here.z, abs=1e-15)
        columns = []
        for i, step in enumerate(((h, 0.0), (0.0, h))):
            ahead = montana.compute_chart(shape, u + step[0], v + step[1])
            behind = montana.compute_chart(shape, u - step[0], v - step[1])
            d = [(np.array(a) - np.array(b)) / (2 * h) for a, b in zip(ahead[:4], behind[:4], strict=True)]
            # Differences of second order: h^2 times third derivatives of order 1, relative to 1 m and 1 / m.
            assert d[0] == pytest.approx(here.metric[i] * frame[:, i], abs=1e-10)
            columns.append((frame[:, :2].T @ d[3] / here.metric[i], frame[:, 1] @ d[1] / here.metric[i]))
        form = np.column_stack([k for k, _ in columns])
        assert form == pytest.approx(np.diag(here.curvature), abs=1e-7)
        assert [t for _, t in columns] == pytest.approx(here.torsion, abs=1e-7)


def roll_coordinates(shape: Any, at: montana.Coordinates, w: tuple[float, ...]) -> montana.Coordinates:
    """The coordinates after rolling by the rotation vector `w` (3,) rad, in a hundred steps of the fourth order."""
    h = 0.01
    for _ in range(100):
        total, slope, ahead = at, at, at
        for weight, part in ((1, 0.5), (2, 0.5), (2, 1.0), (1, 0.0)):
            slope = montana.compute_rolling_rates(RADIUS, shape, ahead, w)
            total, ahead = montana.advance(total, weight * h / 6.0, slope), montana.advance(at, part * h, slope)
        at = total
    return at


@pytest.mark.sampled(5)
@pytest.mark.parametrize("name", SHAPES)
def test_both_forms_agree(name: str) -> None:
    shape, rng = SHAPES[name], np.random.default_rng(41)
    for u, v in STARTS:
        at = start(shape, *scaled(name, u, v), psi=rng.uniform(-3, 3))
        center, normal = contact(shape, at)
        before = orientation(shape, at)
        w = rng.normal(size=3)
        w *= 0.4 / np.linalg.norm(w)
        after = roll_coordinates(shape, at, tuple(map(float, w)))
        end, _ = contact(shape, after)
        points, normals, _ = roll_path(shape, RADIUS, center, normal, lambda _, w=w: w, 1.0).at(np.array([1.0]))
        # Both are integrated: a hundred steps of order 4 leave 1e-11 of a radian near a chart's pole.
        assert end == pytest.approx(points[0] + RADIUS * normals[0], abs=1e-12)
        assert orientation(shape, after) == pytest.approx(rodrigues(w) @ before, abs=1e-10)
        if name != "spheroid" and "hollow" not in name:
            method = METHODS["montana_rk4"]
            rk4 = rolled_by(method, shape, tuple(map(float, center)), tuple(map(float, normal)), w, 100)
            assert end == pytest.approx(rk4.center, abs=1e-12)


@pytest.mark.parametrize("name", SHAPES)
def test_slip_and_spin(name: str) -> None:
    shape, rng = SHAPES[name], np.random.default_rng(42)
    u, v = scaled(name, *STARTS[0])
    at = start(shape, u, v, psi=0.7)
    here = montana.compute_chart(shape, u, v)
    x, y, z = (np.array(a) for a in montana.compute_finger_axes(here, at.psi))
    omega, slip = rng.normal(size=3), rng.normal(size=2) * 0.01
    out = montana.compute_rates(RADIUS, shape, at, tuple(map(float, omega)), tuple(map(float, slip)))
    moved = out.u_o * here.metric[0] * np.array(here.x) + out.v_o * here.metric[1] * np.array(here.y)
    n, bend = compute_normal_and_curvature(np.array(here.point), shape)
    w, velocity = omega[0] * x + omega[1] * y + omega[2] * z, slip[0] * x + slip[1] * y
    expected = np.linalg.solve(bend + np.eye(3) / RADIUS, np.cross(w, n) + velocity / RADIUS)
    assert moved == pytest.approx(expected, abs=1e-15)
    # The contact point moves farther on the object than on the fingertip by the slip.
    on_finger = montana.compute_chart(model.Sphere(RADIUS, 1.0), at.u_f, at.v_f)
    rolled_over = out.u_f * on_finger.metric[0] * x + out.v_f * on_finger.metric[1] * y
    assert moved - rolled_over == pytest.approx(velocity, abs=1e-15)
    spin = montana.compute_rates(RADIUS, shape, at, (0.0, 0.0, 2.0), (0.0, 0.0))
    assert spin == pytest.approx((0.0, 0.0, 0.0, 0.0, 2.0), abs=1e-15)
