"""Fingertip in a hollow that it nearly fills, and in a slot: friction in closed form, and no spurious events.

In a round hollow of radius R the centre moves on a sphere of radius h = R - r. With the probe at a fixed distance d
from the middle and the contact at an angle a to it, the depth is d cos a - h and the tangential deflection d sin a. A
slide ends at d sin a = mu (d cos a - h). On a sphere h = -(R + r) and d = depth + h; on a plane both are infinite, and
the deflection is mu times the depth.
"""

from typing import Any

import numpy as np
import pytest
from helpers.examples import Cases
from helpers.touching import Array, causes, engine, make_object, visit, wall
from references.hand import plane_engine
from scipy.optimize import brentq

from softfinger.proxy.engine import Engine
from softfinger.proxy.record import CAUSE_NAMES

pytestmark = pytest.mark.plain
R, K, DEPTH, MU_S, MU_D = 0.01, 1000.0, 0.001, 0.6, 0.5


def equilibrium_angle(h: float, d: float, mu: float) -> float:
    sign = np.sign(h)
    return float(brentq(lambda a: d * np.sin(a) - mu * sign * (d * np.cos(a) - h), 0.0, np.arccos(min(h / d, d / h))))


def rolled(radius: float, inside: bool, turn: float, ticks: int) -> Array:
    """Records of a finger pressed 1 mm, held in position and rolled by `turn` rad about x, from the tick of touch."""
    table = {"shape": "sphere", "radius_m": radius, "inside": inside}
    running = plane_engine(table=table, rolling={"method": "rotation_vector"})
    angles = np.concatenate([[0.0], np.linspace(0.0, turn, ticks + 1)])
    poses = np.zeros((len(angles), 7))
    poses[:, 2] = -(radius - R + DEPTH) if inside else radius + R - DEPTH
    poses[:, 3], poses[:, 4] = np.cos(0.5 * angles), np.sin(0.5 * angles)
    return running.run(poses, 1e-3)


@pytest.mark.parametrize("is_against_wall", [False, True])
@pytest.mark.parametrize("depth", [0.001, 0.004, 0.008])
def test_a_pure_roll_in_a_hollow_winds_up_nothing(depth: float, is_against_wall: bool) -> None:
    """The centre moves on a circle of radius h, the probe with it on one of radius h + depth, and the fingertip rotates
    back by h / R. A tick follows the tangent of its arc: an error of the third order in the angle."""
    h, angle, ticks = 0.002, 1e-3, 300
    bowl = make_object("bowl", "sphere", radius_m=R + h, inside=True)
    walls = [wall("wall", (1.0, 0.0, 0.0), offset=-R)] if is_against_wall else []
    angles = np.concatenate([[0.0], angle * np.arange(ticks)])
    poses = np.zeros((len(angles), 7))
    poses[:, 0] = -0.0005 if is_against_wall else 0.0
    poses[:, 1], poses[:, 2] = (h + depth) * np.sin(angles), -(h + depth) * np.cos(angles)
    poses[:, 3], poses[:, 4] = np.cos(0.5 * angles * h / R), -np.sin(0.5 * angles * h / R)
    force = engine(bowl, *walls, rolling={"method": "rotation_vector"}).run(poses, 1e-3)["force"]
    tangential = force[:, 1] * np.cos(angles) + force[:, 2] * np.sin(angles)
    np.testing.assert_allclose(tangential, 0.0, atol=K * (h + depth) * ticks * angle**3)


@pytest.mark.sampled(2)
@pytest.mark.parametrize("ticks", [30, 100, 2000], ids=lambda n: f"{n} ticks")
@pytest.mark.parametrize("clearance", [1e-7, 1e-5, 1e-4, 2e-3, 1e-2], ids=lambda h: f"{1e3 * h:g} mm")
def test_a_roll_in_a_hollow_slides_to_the_limit_of_the_cone(clearance: float, ticks: int) -> None:
    """A tick turns the contact by up to 0.2 rad, and the friction limit uses the normal force before the slip: an error
    of mu tan a times that turn."""
    records = rolled(R + clearance, True, 1.0, ticks)
    h, d = clearance, clearance + DEPTH
    a = equilibrium_angle(h, d, MU_D)
    turn = R / clearance / ticks
    missed = 2.0 * MU_D * turn if turn <= 0.2 else 0.0
    tangential, normal = K * d * np.sin(a), K * (d * np.cos(a) - h)
    assert records["contact.tangential_force"][-1] == pytest.approx(tangential, rel=1e-3 + missed)
    assert records["contact.normal_force"][-1] == pytest.approx(normal, rel=1e-3 + missed)
    # The roll carries the centre to -y over the floor of the hollow, as on a plane, and pulls the hand there.
    assert records["proxy.position"][-1, 1] == pytest.approx(-h * np.sin(a), rel=1e-3 + 2.0 * missed)
    assert records["torque"][-1, 0] == pytest.approx(-R * tangential, rel=1e-3 + missed)
    assert causes(records) == ["touch", "theta_max"]


@pytest.mark.parametrize("inside", [True, False])
def test_a_wide_hollow_and_a_large_sphere_are_planes(inside: bool) -> None:
    """With R = 100 m the force is mu_d times 1 N, to the ratio of depth and R."""
    records = rolled(100.0, inside, 1.0, 1000)
    assert records["contact.tangential_force"][-1] == pytest.approx(0.5, rel=1e-4)
    assert records["force"][-1] == pytest.approx([0.0, -0.5, 1.0], abs=2e-4)


@pytest.mark.parametrize("clearance", [1e-4, 2e-3])
def test_a_stuck_roll_deflects_by_the_turn_of_the_normal(clearance: float) -> None:
    """While a roll by theta sticks, a = r theta / h and the force is K d sin a, d / h times K r theta for small a."""
    h, d = clearance, clearance + DEPTH
    turn = 0.8 * equilibrium_angle(h, d, MU_S) * h / R
    records = rolled(R + clearance, True, turn, 200)
    angle = np.linspace(0.0, turn, 201) * R / h
    np.testing.assert_allclose(records["contact.tangential_force"][1:], K * d * np.sin(angle), atol=1e-9)
    assert causes(records) == ["touch"]


GRIP: dict[str, Any] = {"stiffness_n_per_m": K, "friction": {"static": 0.6, "kinetic": 0.5}}
TABLES: dict[str, Any] = {"rolling": {"method": "rotation_vector"}, "coupling": {"damping_ns_per_m": 0.0}}


@pytest.mark.parametrize("clearance", [1e-7, 1e-5, 1e-4])
@pytest.mark.parametrize("aslant", [0.0, 0.1])
def test_a_finger_that_crosses_a_slot_makes_a_new_touch(clearance: float, aslant: float) -> None:
    """From one wall to the other within a tick: a touch without wind-up, and no drag or reversal event."""
    offset = -R - clearance
    slot = engine(wall("left", (1, 0, 0), GRIP, offset), wall("right", (-1, 0, 0), GRIP, offset), **TABLES)
    x = np.concatenate([[0.0], np.linspace(-0.0005, 0.0005, 4)])
    records = visit(slot, np.column_stack([x, aslant * x, np.zeros(5)]))
    force = records["force"]
    assert force[3, 0] == pytest.approx(-K * (x[3] - clearance), rel=1e-9)
    assert np.abs(force[3, 1:]).max() < 1e-12
    assert [CAUSE_NAMES[int(c)] for c in records["contact.cause"]] == ["none", "touch", "none", "touch", "none"]


FAR = {"name": "far", "shape": "plane", "position_m": [0.0, 0.0, -9.0]}
HALF = 0.005
"""Half length of the capsule, m."""


def ends(distance: float) -> list[dict[str, Any]]:
    return [
        {"name": "below", "shape": "plane", "position_m": [0.0, 0.0, -distance]},
        {"name": "above", "shape": "plane", "position_m": [0.0, 0.0, distance], "orientation_wxyz": [0, 1, 0, 0]},
    ]


def in_ball(p: Array, h: float) -> Array:
    return p * min(1.0, h / max(float(np.linalg.norm(p)), 1e-300))


def in_tube(p: Array, h: float) -> Array:
    return np.array([*(p[:2] * min(1.0, h / max(float(np.hypot(*p[:2])), 1e-300))), p[2]])


def in_capsule(p: Array, h: float) -> Array:
    middle = np.array([0.0, 0.0, np.clip(p[2], -HALF, HALF)])
    return middle + in_ball(p - middle, h)


def in_short_tube(p: Array, h: float) -> Array:
    return np.array([*in_tube(p, h)[:2], np.clip(p[2], -h, h)])


def in_dome(p: Array, h: float) -> Array:
    return in_tube(p, h) * [1.0, 1.0, 0.0] if p[2] < 0.0 else in_ball(p, h)


NEARLY_FILLED: dict[str, Any] = {
    "bowl": (lambda h: [{"shape": "sphere", "radius_m": R + h}, FAR], in_ball),
    "tube": (lambda h: [{"shape": "cylinder", "radius_m": R + h}, FAR], in_tube),
    "capsule": (lambda h: [{"shape": "capsule", "radius_m": R + h, "length_m": 2.0 * HALF}, FAR], in_capsule),
    "socket": (lambda h: [{"shape": "cylinder", "radius_m": R + h, "length_m": 2.0 * (R + h)}], in_short_tube),
    "tube between planes": (lambda h: [{"shape": "cylinder", "radius_m": R + h}, *ends(R + h)], in_short_tube),
    "dome": (lambda h: [{"shape": "sphere", "radius_m": R + h}, ends(R)[0]], in_dome),
}
"""Objects, the first of which is touched from inside, and the function that returns the nearest allowed centre."""


@pytest.mark.sampled(4)
@pytest.mark.scaled
@pytest.mark.parametrize("clearance", [1e-4, 2e-3], ids=lambda h: f"{1e3 * h:g} mm")
@pytest.mark.parametrize("name", NEARLY_FILLED)
def test_proxy_in_a_hollow_is_the_nearest_point_to_the_probe(name: str, clearance: float, cases: Cases) -> None:
    """In closed form, after a jump between random positions up to ten clearances from the middle."""
    objects, nearest = NEARLY_FILLED[name]
    hollow, *others = objects(clearance)
    material = {"material": {"stiffness_n_per_m": K}}
    tables = [{"name": "hollow", "inside": True, **hollow, **material}, *({**table, **material} for table in others)]
    running, rng = Engine({"fingertip": {"radius_m": R}, "object": tables}), np.random.default_rng(5)
    for _ in range(cases(20, 1000)):
        start, probe = rng.normal(size=(2, 3)) * clearance * 10.0 ** rng.uniform(-0.3, 1.0)
        running.reset()
        for place in ([0.0, 0.0, 0.1 * clearance], start, *[probe] * 6):
            step = running.step(place, [1.0, 0.0, 0.0, 0.0])
        wanted = K * (nearest(probe, clearance) - probe)
        # The search ends if a round moves the proxy by less than 1e-13 of the radius, or after ten rounds.
        np.testing.assert_allclose(step.force, wanted, rtol=0.0, atol=1e-6 * (1.0 + np.linalg.norm(wanted)))


ALONE: dict[str, Any] = {
    "ball": ({"shape": "sphere"}, in_ball),
    "tube": ({"shape": "cylinder"}, in_tube),
    "capsule": ({"shape": "capsule", "length_m": 2.0 * HALF}, in_capsule),
}


@pytest.mark.parametrize("clearance", [1e-4, 0.03], ids=lambda h: f"{1e3 * h:g} mm")
@pytest.mark.parametrize("name", ALONE)
def test_a_hollow_touched_from_afar_starts_unwound(name: str, clearance: float) -> None:
    """A jump from the middle by up to thirty clearances, with friction: no tangential part."""
    (table, nearest), rng = ALONE[name], np.random.default_rng(2)
    running = plane_engine(table={**table, "radius_m": R + clearance, "inside": True})
    for _ in range(50):
        towards = rng.normal(size=3)
        probe = towards / np.linalg.norm(towards[:2]) * clearance * rng.uniform(1.1, 30.0)
        running.reset()
        running.step(0.3 * clearance * rng.uniform(-1.0, 1.0, 3), [1.0, 0.0, 0.0, 0.0])
        step = running.step(probe, [1.0, 0.0, 0.0, 0.0])
        wanted = nearest(probe, clearance)
        assert step.cause == "touch" and step.proxy_position == pytest.approx(wanted, rel=0.0, abs=1e-12)
        assert step.force == pytest.approx(K * (wanted - probe), rel=0.0, abs=1e-9)
