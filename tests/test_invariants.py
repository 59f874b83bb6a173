"""What must hold for every input: ten thousand random cases each, found and shrunk by Hypothesis."""

import functools

import numpy as np
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from softfinger.config.load import build
from softfinger.config.schema import Scene
from softfinger.proxy.engine import Engine

R = 0.01
CASES = settings(
    max_examples=10_000, deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)  # fmt: skip
GRIP = {
    "stiffness_n_per_m": 1000.0,
    "damping_ns_per_m": 1.0,
    "friction": {"static": 0.6, "kinetic": 0.5},
    "torsion": {"stiffness_nm_per_rad": 0.05, "friction_length_m": 0.004},
}
SLICK = {"stiffness_n_per_m": 1000.0}
TURNED = [0.8, 0.36, 0.48, 0.0]
HALF = np.array([0.02, 0.015, 0.01])

coordinate = st.floats(-0.06, 0.06)
point = st.tuples(coordinate, coordinate, coordinate)
part = st.floats(-1.0, 1.0)
quaternion = st.tuples(part, part, part, part).filter(lambda q: sum(x * x for x in q) > 1e-3)
shift = st.tuples(*[st.floats(0.1, 1.0)] * 3)  # never zero: a ball at the origin has no place to tune
small_turn = st.tuples(*[st.floats(-0.1, 0.1)] * 3)
walk = st.lists(st.tuples(point, small_turn), min_size=1, max_size=6)


def rotation(q):
    w, x, y, z = np.asarray(q) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def product(a, b):
    return np.array(
        [
            a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
            a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
            a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
            a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
        ]
    )


def turn(v):
    return np.array([1.0, *(0.5 * np.asarray(v))]) / np.linalg.norm([1.0, *(0.5 * np.asarray(v))])


def scene(kind, material="grip", at=(0.5, 0.5, 0.5)):
    stuff = {"grip": GRIP, "slick": SLICK}[material]
    ball = {"name": "ball", "shape": "sphere", "radius_m": 0.02, "material": stuff}
    things = {
        "zoo": [
            {"name": "floor", "shape": "plane", "position_m": [0, 0, -0.02], "material": stuff},
            ball | {"position_m": [0.03, 0.0, 0.0]},
            {
                "name": "block",
                "shape": "box",
                "size_m": (2 * HALF).tolist(),
                "position_m": [-0.03, 0.01, 0.0],
                "orientation_wxyz": TURNED,
                "material": stuff,
            },
        ],
        "ball": [ball],
        "ball elsewhere": [ball | {"position_m": list(at)}],
    }[kind]
    tables = {} if material == "slick" else {"rolling": {"method": "euler_zxz"}}
    return build(Scene, {"fingertip": {"radius_m": R}, "object": things, **tables}, "invariants")


@functools.cache
def engine(kind, material="grip"):
    return Engine(scene(kind, material))


def gaps(x):
    """Distances from the zoo's objects, in formulas of their own."""
    local = rotation(TURNED).T @ (x - np.array([-0.03, 0.01, 0.0]))
    beyond = np.abs(local) - HALF
    block = np.linalg.norm(np.maximum(beyond, 0.0)) + min(beyond.max(), 0.0)
    return x[2] + 0.02, np.linalg.norm(x - np.array([0.03, 0.0, 0.0])) - 0.02, block


def visit(running, steps):
    """Steps of a fresh contact along a walk of points and small turns."""
    running.reset()
    orientation = np.array([1.0, 0.0, 0.0, 0.0])
    for position, turned in steps:
        orientation = product(turn(turned), orientation)
        yield np.asarray(position), orientation, running.step(position, orientation)


@CASES
@given(walk)
def test_proxy_is_never_inside_any_object(steps):
    """After every tick the fingertip's sphere about the proxy is outside all objects, unless it began inside one."""
    running = engine("zoo")
    start = np.array([0.0, 0.0, 0.055])
    for _, _, step in visit(running, [(start, (0.0, 0.0, 0.0)), *steps]):
        # The solve stops at 1e-10 of the radius; these formulas round too.
        assert min(gaps(step.proxy_position)) > R * (1.0 - 1e-9)


@CASES
@given(walk)
def test_force_is_within_the_friction_cone_and_never_pulls(steps):
    """The tangential force is at most mu_s times the normal force, which is not negative; torsion keeps its limit."""
    for _, _, step in visit(engine("ball"), steps):
        assert step.normal_force >= 0.0
        assert step.tangential_force <= 0.6 * step.normal_force * (1.0 + 1e-9) + 1e-15
        moment = float(step.torque @ step.normal)
        assert abs(moment) <= 0.004 * step.normal_force * (1.0 + 1e-9) + 1e-15


@CASES
@given(point, st.lists(st.tuples(*[st.floats(-0.003, 0.003)] * 3), min_size=1, max_size=8))
def test_frictionless_contact_is_a_gradient(start, moves):
    """The force is exactly that of the potential K depth^2 / 2, which gives no energy in any closed cycle."""
    running = engine("ball", "slick")
    running.reset()
    x = np.asarray(start) + np.sign(start) * 0.03  # begins outside, and goes in by steps of some millimetres
    running.step(x, (1.0, 0.0, 0.0, 0.0))
    for move in moves:
        goal = 0.9 * (x + move)
        distance = np.linalg.norm(goal)
        if distance < 0.012:  # through the middle there is no one nearest point
            continue
        x = goal
        step = running.step(x, (1.0, 0.0, 0.0, 0.0))
        depth = max(0.02 + R - distance, 0.0)
        np.testing.assert_allclose(step.force, 1000.0 * depth * x / distance, atol=1e-9)


@CASES
@given(quaternion, shift, st.lists(st.tuples(point, small_turn), min_size=2, max_size=4))
def test_results_do_not_depend_on_the_world_frame(q, moved, steps):
    """A rigid motion of the whole world, scene and hand, moves all results with it."""
    turned = np.asarray(q) / np.linalg.norm(q)
    matrix, center = rotation(turned), np.asarray(moved)
    here, there = engine("ball"), engine("ball elsewhere")
    here.reset()
    there.reset()
    there.tune(scene("ball elsewhere", at=center.tolist()))
    orientation = np.array([1.0, 0.0, 0.0, 0.0])
    # Begins outside: a first pose in the very middle of the ball has no normal but the coordinates' own.
    for position, small in [((0.05, 0.02, 0.03), (0.0, 0.0, 0.0)), *steps]:
        orientation = product(turn(small), orientation)
        one = here.step(position, orientation)
        other = there.step(matrix @ position + center, product(turned, orientation))
        if one.mode != other.mode:
            # Only where a threshold is met to the last digit: that of touching, or that of the friction cone.
            touching = abs(np.linalg.norm(position) - 0.03) < 1e-9
            assert touching or abs(one.tangential_force - 0.6 * one.normal_force) < 1e-9
            return
        # Rounding of coordinates up to 1 m against a radius of 10 mm, through a few ticks, times 1000 N/m.
        np.testing.assert_allclose(other.force, matrix @ one.force, atol=1e-9)
        np.testing.assert_allclose(other.torque, matrix @ one.torque, atol=1e-9)
        np.testing.assert_allclose(other.proxy_position, matrix @ one.proxy_position + center, atol=1e-12)


@CASES
@given(walk)
def test_finger_side_point_is_exactly_that_of_the_orientation(steps):
    """The contact on the fingertip is -r R^T n, so it cannot drift from the orientation."""
    for _, orientation, step in visit(engine("zoo"), steps):
        if step.mode:
            expected = -R * rotation(orientation).T @ step.normal
            np.testing.assert_allclose(step.finger_point, expected, atol=1e-16 * 10)
            assert abs(np.linalg.norm(step.normal) - 1.0) < 1e-14


anything = st.floats(-1e6, 1e6)
any_quaternion = st.tuples(*[st.floats(-1e6, 1e6)] * 4).filter(lambda q: 1e-6 <= np.linalg.norm(q) <= 1e6)
any_dt = st.one_of(st.just(0.0), st.floats(1e-9, 1e3))


@CASES
@given(st.lists(st.tuples(st.tuples(anything, anything, anything), any_quaternion, any_dt), min_size=1, max_size=4))
def test_no_finite_input_gives_anything_but_finite_output(ticks):
    """Poses a thousand kilometres apart, any rotation, any time step: every number that comes out is finite."""
    running = engine("zoo")
    running.reset()
    for position, orientation, dt in ticks:
        for value in running.step(position, orientation, dt):
            assert isinstance(value, str) or np.isfinite(value).all()
