"""A finger that rolls without slip on moving and rotating objects, single or among several."""

from typing import Any

import numpy as np
import pytest
from references.rotation import multiply, quaternion, rodrigues
from test_invariants import R
from test_moving_touch import Driver, K, scene

from softfinger.config.schema import Scene

pytestmark = pytest.mark.plain

DT = 1e-3
RADIUS, DEPTH, TICKS = 0.02, 0.0005, 60
GRIP = {"stiffness_n_per_m": K, "friction": {"static": 50.0, "kinetic": 50.0}}
TABLES: dict[str, Any] = {
    "rolling": {"method": "rotation_vector"},
    "coupling": {"stiffness_n_per_m": K, "damping_ns_per_m": 0.0},
}
BALL = {"shape": "sphere", "radius_m": RADIUS, "material": GRIP}
FAR = {"shape": "plane", "position_m": [0.0, 0.0, -1.0], "motion": None, "material": GRIP}
PLACES = ([BALL], [FAR, BALL])


def company(objects: list[dict[str, Any]]) -> Scene:
    return scene(*objects, **TABLES)


@pytest.mark.scaled
def test_rolling_on_a_moving_sphere_winds_nothing(cases: Any) -> None:
    """W = (R w_o + r w_f) / (R + r) turns the normal of a roll without slip: n = exp(W t) n_0, with the probe on it,
    DEPTH below the proxy. If anything turns by a in a tick, the error is of third order in a for a single object, since
    the rotations do not commute, and of second order in the roll among several, whose depth is applied at both ends of
    a tick."""
    random = np.random.default_rng(3)
    for _ in range(cases(2, 40)):
        n0, speed = random.normal(size=3), random.uniform(-0.05, 0.05, 3)
        n0 /= np.linalg.norm(n0)
        object_rate, finger_rate = random.uniform(-1.5, 1.5, 3), random.uniform(-1.5, 1.5, 3)
        turn = (RADIUS * object_rate + R * finger_rate) / (RADIUS + R)
        for objects in PLACES:
            driver = Driver(company(objects))
            worst = 0.0
            for tick in range(-5, TICKS):
                t = max(tick, 0) * DT
                n, center = rodrigues(turn * t) @ n0, speed * t
                depth = DEPTH * min((tick + 6) / 5.0, 1.0)  # pressed straight down before anything moves
                pose = np.hstack([center + (RADIUS + R - depth) * n, quaternion(finger_rate * t)])
                ball = center, quaternion(object_rate * t)
                step = driver.step(pose, *(ball if entry is BALL else None for entry in objects))
                worst = max(worst, step.tangential_force)
                assert step.normal_force == pytest.approx(K * depth, abs=1e-9)
            a = DT * max(np.linalg.norm(object_rate - turn), np.linalg.norm(finger_rate - object_rate))
            bound = K * TICKS * ((R + RADIUS) * a**3 if len(objects) == 1 else 2.0 * DEPTH * a**2)
            assert worst < bound, (len(objects), worst, bound)


@pytest.mark.scaled
def test_moving_with_a_corner_as_one_body_winds_nothing(cases: Any) -> None:
    """Two walls and a sphere on a common carrier. Positions of 0.1 m round to 1e-17 m, times K."""
    random = np.random.default_rng(4)
    wall = {"shape": "plane", "material": GRIP}
    over = np.sqrt((R + RADIUS) ** 2 - 2.0 * R**2)  # the sphere is below the finger that touches both walls
    placed = [(wall, [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]), (wall, [0.0, 0.0, 0.0], quaternion([0.0, np.pi / 2, 0.0]))]
    placed.append((BALL, [0.0, -over, 0.0], [1.0, 0.0, 0.0, 0.0]))
    for _ in range(cases(2, 40)):
        rate, speed = random.uniform(-3.0, 3.0, 3), random.uniform(-0.1, 0.1, 3)
        driver = Driver(company([entry for entry, _, _ in placed]))
        for tick in range(-5, TICKS):
            t = max(tick, 0) * DT
            turned, at = rodrigues(rate * t), speed * t
            depth = DEPTH * min((tick + 6) / 5.0, 1.0) * np.array([1.0, 2.0, 3.0])
            finger = np.array([R, 0.0, R]) - depth
            places = [(at + turned @ x, multiply(quaternion(rate * t), q)) for _, x, q in placed]
            step = driver.step(np.hstack([at + turned @ finger, quaternion(rate * t)]), *places)
            if tick < 0:
                continue
            np.testing.assert_allclose(turned.T @ step.force, K * depth, atol=1e-9)
            assert step.tangential_force < 1e-9 and abs(step.torsion) < 1e-9
