"""Moving objects: touch depends only on the relative motion of finger and object; poses and rolls in closed form."""

import functools
import math
from typing import Any

import msgspec
import numpy as np
import pytest
from conftest import paper_scene
from helpers.examples import examples
from helpers.touching import Array, causes
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike
from references.rotation import matrix, multiply, quaternion, rodrigues
from test_invariants import GRIP, HALF, SLICK, R, numbers, visits

from softfinger.config.load import build
from softfinger.config.schema import Scene
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.query.motion import compute_pose
from softfinger.proxy.record import AT, CAUSE_NAMES
from softfinger.proxy.scene import build_scene

pytestmark = pytest.mark.plain

DT, K = 1e-3, 1000.0
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
ROUNDING_N = 1e-10
"""Positions of up to 0.1 m round to 1e-17 m, and a rotation and its inverse to a little more, times K."""


def scene(*tables_of_objects: dict[str, Any], **tables: Any) -> Scene:
    """Scene of frictionless objects by default, moved by the test (`driven`) unless they define a motion."""
    base = {"material": SLICK, "motion": {"kind": "driven"}}
    objects = [{"name": f"thing {i}", **base, **entry} for i, entry in enumerate(tables_of_objects)]
    for entry in objects:
        if entry["motion"] is None:
            del entry["motion"]
    head = {"fingertip": {"radius_m": R}, "probe": {"velocity_time_constant_s": 0.0}}
    return build(Scene, {**head, "object": objects, **tables}, "moving objects")


class Driver:
    def __init__(self, config: Scene) -> None:
        self.scene, self.engine = config, Engine(config)

    def step(self, finger: ArrayLike, *places: tuple[ArrayLike, ArrayLike] | None, dt: float = DT) -> Any:
        """Run one tick with the finger at (7,) or (3,) and each object at its position (3,) and orientation (4,)."""
        objects = list(self.scene.object)
        for i, place in enumerate(places):
            if place is not None:
                at, turn = (tuple(np.asarray(part, float).tolist()) for part in place)
                objects[i] = msgspec.structs.replace(objects[i], position_m=at, orientation_wxyz=turn)
        self.engine.tune(msgspec.structs.replace(self.scene, object=tuple(objects)))
        pose = np.asarray(finger, float)
        return self.engine.step(pose[:3], pose[3:] if len(pose) == 7 else UPRIGHT, dt)


SHAPES: dict[str, tuple[dict[str, Any], float, float]] = {
    "plane": ({"shape": "plane"}, 0.0, 0.0),
    "sphere": ({"shape": "sphere", "radius_m": 0.02}, 0.0, 0.02),
    "box": ({"shape": "box", "size_m": [0.05, 0.05, 0.03]}, 0.0, 0.015),
    "plate": ({"shape": "box", "size_m": [0.05, 0.05, 0.0005]}, 0.0, 0.00025),
    "can": ({"shape": "cylinder", "radius_m": 0.02, "length_m": 0.04}, 0.0, 0.02),
    "ellipsoid": ({"shape": "ellipsoid", "semi_axes_m": [0.03, 0.02, 0.01]}, 0.0, 0.01),
    "torus": ({"shape": "torus", "major_radius_m": 0.03, "minor_radius_m": 0.005}, 0.03, 0.005),
    "hollow ball": ({"shape": "sphere", "radius_m": 0.03, "inside": True}, 0.0, -0.03),
    "hollow box": ({"shape": "box", "size_m": [0.06, 0.06, 0.06], "inside": True}, 0.0, -0.03),
}
"""Shapes with x and height, m, of the surface point that meets a finger above when the object rises."""
ALONE = ("plane", "sphere", "plate", "hollow ball")
"""Shapes for tests that do not depend on the shape; each scene compiles for several seconds."""
TICKS = 250
HEIGHT = -0.01 * np.cos(2.0 * np.pi * np.arange(1, TICKS + 1) / TICKS)
"""Height of an object that rises by 20 mm in an eighth of a second and sinks again."""


@pytest.mark.sampled(2)
@pytest.mark.parametrize("retreat", [0.0, 0.004], ids=["still", "retreating"])
@pytest.mark.parametrize("name", SHAPES)
def test_a_rising_object_presses_on_the_finger(name: str, retreat: float) -> None:
    shape, x, top = SHAPES[name]
    finger = np.column_stack([np.full(TICKS, x), np.zeros(TICKS), top + R + retreat * DT * np.arange(1, TICKS + 1)])
    driver = Driver(scene(shape))
    steps = [driver.step(at, ((0.0, 0.0, h), UPRIGHT)) for at, h in zip(finger, HEIGHT, strict=True)]
    expected = K * np.maximum(HEIGHT + top + R - finger[:, 2], 0.0)
    assert expected.max() > 8.0
    np.testing.assert_allclose([s.force for s in steps], expected[:, None] * [0.0, 0.0, 1.0], atol=ROUNDING_N)
    assert [s.cause for s in steps if s.cause != "none"] == ["touch", "release"]
    if name in ALONE:  # and with a motion of the object itself
        rise = {"kind": "sinusoid", "translation_m": [0, 0, 0.01], "frequency_hz": 4.0, "phase_rad": -np.pi / 2}
        records = Engine(scene(shape | {"motion": rise})).run(np.hstack([finger, np.tile(UPRIGHT, (TICKS, 1))]), DT)
        np.testing.assert_allclose(records["force"], expected[:, None] * [0.0, 0.0, 1.0], atol=ROUNDING_N)
        assert causes(records) == ["touch", "release"]


SWING = {"kind": "turntable", "axis": [0, 1, 0], "rate_rad_per_s": -2.0, "pivot_m": [0.0, 0.0, 0.0]}
PADDLE = {"shape": "box", "size_m": [0.2, 0.05, 0.001]}


def test_a_swinging_paddle_pushes_a_still_finger() -> None:
    """A thin paddle rotates through the origin by phi under a finger at (length, 0, h); the force is K times the depth.
    The finger is h cos phi - length sin phi above the paddle's midplane and stays on that face at any depth."""
    length, h, angle = 0.06, 0.03, 2.0 * DT * np.arange(1, 501)
    records = Engine(scene(PADDLE | {"motion": SWING})).run(np.tile([length, 0.0, h, *UPRIGHT], (500, 1)), DT)
    depth = np.maximum(0.0005 + R - h * np.cos(angle) + length * np.sin(angle), 0.0)
    normal = np.column_stack([-np.sin(angle), np.zeros(500), np.cos(angle)])
    assert depth.max() > 0.02
    np.testing.assert_allclose(records["force"], K * depth[:, None] * normal, atol=ROUNDING_N)
    assert causes(records) == ["touch"]


def test_damping_is_against_the_speed_of_the_object() -> None:
    """Damping acts on the object's speed from the first tick: 3 N s/m at 0.02 m/s adds up to 0.06 N."""
    driver = Driver(scene({"shape": "plane", "material": {"stiffness_n_per_m": K, "damping_ns_per_m": 3.0}}))
    height = 0.02 * DT * np.arange(1, 101)
    force = [driver.step((0.0, 0.0, R + 0.00099), ((0.0, 0.0, z), UPRIGHT)).force[2] for z in height]
    elastic = K * np.maximum(height - 0.00099, 0.0)
    # Rounding of B 1e-16 m / DT.
    np.testing.assert_allclose(force, np.minimum(elastic + 3.0 * 0.02, 2.0 * elastic), atol=1e-9)


@pytest.mark.parametrize("dt", [DT, 0.0])
@pytest.mark.parametrize("name", SHAPES)
def test_an_object_that_jumps_over_the_finger_pushes_it_forward(name: str, dt: float) -> None:
    shape, x, top = SHAPES[name]
    driver = Driver(scene(shape))
    finger = (x, 0.0, top + R + 0.001)
    assert driver.step(finger, ((0.0, 0.0, 0.0), UPRIGHT)).cause == "none"
    met = driver.step(finger, ((0.0, 0.0, 0.03), UPRIGHT), dt=dt)
    jumped = driver.step(finger, ((0.0, 0.0, 0.03), UPRIGHT), dt=dt)
    for step in (met, jumped):
        np.testing.assert_allclose(step.force, [0.0, 0.0, K * 0.029], atol=ROUNDING_N)
    assert (met.cause, jumped.cause) == ("touch", "none")


@pytest.mark.parametrize("name", ALONE)
def test_an_object_placed_around_the_finger_pushes_it_out(name: str) -> None:
    shape, x, top = SHAPES[name]
    driver = Driver(scene(shape | {"motion": None, "position_m": [0.0, 0.0, -0.5]}))
    finger = (x, 0.0, top + R)
    if top < 0.0 or name == "plane":  # from elsewhere, the finger would be in the material of a hollow object
        driver.step(finger, ((0.0, 0.0, -0.001), UPRIGHT))
    else:
        driver.step(finger, ((0.0, 0.0, -0.5), UPRIGHT))
    step = driver.step(finger, ((0.0, 0.0, 0.001), UPRIGHT))
    np.testing.assert_allclose(step.force, [0.0, 0.0, K * 0.001], atol=ROUNDING_N)
    assert step.cause == "touch"


@pytest.mark.sampled(1)
@pytest.mark.parametrize("thickness", [0.1, 0.001])
@pytest.mark.parametrize("jump", [0.0001, 0.002, 0.04], ids=lambda distance: f"{1000 * distance:g} mm")
def test_a_second_object_is_met_while_the_first_is_touched(jump: float, thickness: float) -> None:
    floor = {"shape": "plane", "motion": None}
    driver = Driver(scene(floor, {"shape": "box", "size_m": [thickness, 0.2, 0.2]}))
    for z in (R + 0.001, R - 0.001):
        driver.step((0.0, 0.0, z), None, ((-0.02 - 0.5 * thickness, 0.0, 0.0), UPRIGHT))
    faces = np.arange(-0.02, 0.005, jump) + jump
    for face in faces:
        step = driver.step((0.0, 0.0, R - 0.001), None, ((face - 0.5 * thickness, 0.0, 0.0), UPRIGHT))
        np.testing.assert_allclose(step.force, [K * max(face + R, 0.0), 0.0, 1.0], atol=1e-9)
    assert faces[-1] > 0.0


BLOCK = {"shape": "box", "size_m": (2 * HALF).tolist(), "material": GRIP}
BALL = {"shape": "sphere", "radius_m": 0.02, "material": GRIP}
ROLLING = {"rolling": {"method": "euler_zxz"}, "coupling": {"damping_ns_per_m": 2.0}}


@functools.cache
def pair(name: str) -> tuple[Engine, Driver]:
    entries = {"ball": [BALL], "block": [BLOCK], "hollow": [BALL | {"radius_m": 0.05, "inside": True}]}[name]
    still = Engine(scene(*[entry | {"motion": None} for entry in entries], **ROLLING))
    return still, Driver(scene(*entries, **ROLLING))


@pytest.mark.sampled(2)
@pytest.mark.scaled
@pytest.mark.parametrize("name", ["ball", "block", "hollow"])
def test_moving_the_object_equals_moving_the_finger(name: str) -> None:
    """In the object's frame, to rounding, with friction, rolling and damping. Steps are up to 10 mm per tick, and the
    coupling's damping multiplies their rounding by 2 N s/m / DT. Forces above 1 N have a relative tolerance."""
    still, driver = pair(name)

    @examples(25, 300)
    @given(numbers(6, 6), st.integers(2, 6))
    def check(draws: Array, count: int) -> None:
        poses = visits((0.0, 0.0, 0.055 if name != "hollow" else 0.0), draws[:count])
        still.reset()
        driver.engine.reset()
        hand, turn = np.array([0.01, -0.02, 0.03]), np.array([0.5, 0.1, -0.7, 0.5])
        turn /= np.linalg.norm(turn)
        records = still.run(poses, DT)
        for row, pose in zip(records, poses, strict=True):
            led = multiply(turn, pose[3:] * [1.0, -1.0, -1.0, -1.0])
            led /= np.linalg.norm(led)
            world = matrix(led)
            step = driver.step(np.hstack([hand, turn]), (hand - world @ pose[:3], led))
            mode, normal_force = row[AT.contact_mode], row[AT.contact_normal_force]
            if step.mode != mode or step.cause != CAUSE_NAMES[int(row[AT.contact_cause])]:
                room = 0.6 * normal_force - row[AT.contact_tangential_force]
                assert abs(room) < 1e-7 or abs(row[AT.contact_penetration]) < 1e-9, (step.cause, row)
                return
            for at, got in ((AT.force, step.force), (AT.torque, step.torque)):
                assert np.abs(world.T @ got - row[at : at + 3]).max() < 1e-8 * max(1.0, normal_force)

    check()


STILL = model.Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
TILTED = model.Pose((0.3, -0.1, 0.2), (0.5, 0.5, -0.5, 0.5))
DRIVEN = model.NO_MOTION._replace(kind=model.DRIVEN)


def sinusoid(translation: Any, axis: Any, angle: float, frequency: float, phase: float) -> model.Motion:
    keys = {"translation": translation, "axis": axis, "angle": angle, "frequency": frequency, "phase": phase}
    return model.NO_MOTION._replace(kind=model.SINUSOID, **keys)


def turntable(axis: Any, rate: float, pivot: Any) -> model.Motion:
    return model.NO_MOTION._replace(kind=model.TURNTABLE, axis=axis, rate=rate, pivot=pivot)


SHAKE = sinusoid((0.01, 0.0, 0.02), (0.0, 0.6, 0.8), 0.4, 2.5, 0.7)
TABLE = turntable((0.0, 0.6, 0.8), 3.0, (0.05, 0.0, -0.02))

times = st.floats(0.0, 1000.0)
both = pytest.mark.parametrize("motion", [SHAKE, TABLE], ids=["sinusoid", "turntable"])


def placed(pose: model.Pose, point: Any) -> Array:
    return np.asarray(matrix(np.array(pose.orientation)) @ np.asarray(point) + pose.position)


def test_without_a_motion_an_object_does_not_move() -> None:
    assert compute_pose(None, TILTED, 123.4) == TILTED and compute_pose(DRIVEN, TILTED, 123.4) == TILTED


def test_sinusoid_swings_by_its_amplitude_in_both_directions() -> None:
    swing = sinusoid((0.01, 0.0, 0.0), (0.0, 0.0, 1.0), 0.5, 2.0, 0.0)
    for time, s in [(0.0, 0.0), (0.125, 1.0), (0.25, 0.0), (0.375, -1.0), (1000.125, 1.0)]:
        pose = compute_pose(swing, STILL, time)
        assert pose.position == pytest.approx((0.01 * s, 0.0, 0.0), abs=1e-14)
        assert pose.orientation == pytest.approx((math.cos(0.25 * s), 0.0, 0.0, math.sin(0.25 * s)), abs=1e-13)


def test_phase_sets_the_start_within_the_cycle() -> None:
    swing = sinusoid((0.0, 0.0, 0.02), (0.0, 0.0, 1.0), 0.0, 5.0, math.pi / 2)
    assert compute_pose(swing, STILL, 0.0).position == pytest.approx((0.0, 0.0, 0.02))


@settings(max_examples=200, deadline=None, derandomize=True)
@given(times)
def test_turntable_does_not_move_its_axis(time: float) -> None:
    pose = compute_pose(TABLE, TILTED, time)
    for along in (-1.0, 0.0, 2.0):
        point = np.array(TABLE.pivot) + along * np.array(TABLE.axis)
        assert placed(pose, point) == pytest.approx(placed(TILTED, point), abs=1e-13)
    corner, pivot = (0.1, 0.2, 0.3), placed(TILTED, TABLE.pivot)
    distance, at_rest = (np.linalg.norm(placed(at, corner) - pivot) for at in (pose, TILTED))
    assert distance == pytest.approx(at_rest, rel=1e-13)


def test_turntable_turns_at_its_rate() -> None:
    table = turntable((0.0, 0.0, 1.0), 2.0, (0.0, 0.0, 0.0))
    for turns in (0.25, 1e6 + 0.25):
        pose = compute_pose(table, STILL, turns * math.pi)
        # The time is a double: at 3e6 s its steps are 5e-10 s, times 2 rad/s.
        assert placed(pose, (1.0, 0.0, 0.0)) == pytest.approx([0.0, 1.0, 0.0], abs=1e-13 if turns < 1.0 else 2e-9)


@both
@settings(max_examples=200, deadline=None, derandomize=True)
@given(time=times)
def test_motion_is_relative_to_the_rest_pose(motion: Any, time: float) -> None:
    here, tilted = compute_pose(motion, STILL, time), compute_pose(motion, TILTED, time)
    for point in [(0.0, 0.0, 0.0), (0.1, -0.2, 0.3)]:
        assert placed(tilted, point) == pytest.approx(placed(TILTED, placed(here, point)), abs=1e-14)


@both
@settings(max_examples=200, deadline=None, derandomize=True)
@given(time=st.floats(allow_nan=False, allow_infinity=False))
def test_pose_is_valid_at_any_finite_time(motion: Any, time: float) -> None:
    pose = compute_pose(motion, TILTED, time)
    assert math.hypot(*pose.orientation) == pytest.approx(1.0, abs=1e-14)
    assert np.linalg.norm(np.array(pose.position) - TILTED.position) < 0.2


def test_every_kind_in_a_file_becomes_its_kernel() -> None:
    swing = {"kind": "sinusoid", "translation_m": [0, 0, 0.01], "frequency_hz": 2, "axis": [0, 3, 4]}
    table = {"kind": "turntable", "rate_rad_per_s": -1, "pivot_m": [0.1, 0, 0]}
    expected = [
        (swing, sinusoid((0.0, 0.0, 0.01), (0.0, 0.6, 0.8), 0.0, 2.0, 0.0)),
        (table, turntable((0.0, 0.0, 1.0), -1.0, (0.1, 0.0, 0.0))),
        ({"kind": "driven"}, DRIVEN),
    ]
    for motion, kernel in expected:
        assert build_scene(paper_scene(table={"motion": motion})).objects.body.motion == kernel
    assert build_scene(paper_scene()).objects.body.motion is None


RADIUS, DEPTH, COUNT = 0.02, 0.0005, 60
STICKY = {"stiffness_n_per_m": K, "friction": {"static": 50.0, "kinetic": 50.0}}
TABLES: dict[str, Any] = {
    "rolling": {"method": "rotation_vector"},
    "coupling": {"stiffness_n_per_m": K, "damping_ns_per_m": 0.0},
}
ROUND = {"shape": "sphere", "radius_m": RADIUS, "material": STICKY}
FAR = {"shape": "plane", "position_m": [0.0, 0.0, -1.0], "motion": None, "material": STICKY}
PLACES = ([ROUND], [FAR, ROUND])


def company(objects: list[dict[str, Any]]) -> Scene:
    return scene(*objects, **TABLES)


@pytest.mark.scaled
def test_rolling_on_a_moving_sphere_winds_nothing(cases: Any) -> None:
    """W = (R w_o + r w_f) / (R + r) turns the normal of a roll without slip: n = exp(W t) n_0, with the probe on it,
    DEPTH below the proxy. If anything turns by a in a tick, the error is of third order in a for a single object, since
    the rotations do not commute, and of second order in the roll with several; their depth is applied at both ends of
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
            for tick in range(-5, COUNT):
                t = max(tick, 0) * DT
                n, center = rodrigues(turn * t) @ n0, speed * t
                depth = DEPTH * min((tick + 6) / 5.0, 1.0)  # pressed straight down before anything moves
                pose = np.hstack([center + (RADIUS + R - depth) * n, quaternion(finger_rate * t)])
                ball = center, quaternion(object_rate * t)
                step = driver.step(pose, *(ball if entry is ROUND else None for entry in objects))
                worst = max(worst, step.tangential_force)
                assert step.normal_force == pytest.approx(K * depth, abs=1e-9)
            a = DT * max(np.linalg.norm(object_rate - turn), np.linalg.norm(finger_rate - object_rate))
            bound = K * COUNT * ((R + RADIUS) * a**3 if len(objects) == 1 else 2.0 * DEPTH * a**2)
            assert worst < bound, (len(objects), worst, bound)


@pytest.mark.scaled
def test_moving_with_a_corner_as_one_body_winds_nothing(cases: Any) -> None:
    """Two walls and a sphere on a common carrier. Positions of 0.1 m round to 1e-17 m, times K."""
    random = np.random.default_rng(4)
    wall = {"shape": "plane", "material": STICKY}
    over = np.sqrt((R + RADIUS) ** 2 - 2.0 * R**2)  # the sphere is below the finger that touches both walls
    placed = [(wall, [0.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0]), (wall, [0.0, 0.0, 0.0], quaternion([0.0, np.pi / 2, 0.0]))]
    placed.append((ROUND, [0.0, -over, 0.0], [1.0, 0.0, 0.0, 0.0]))
    for _ in range(cases(2, 40)):
        rate, speed = random.uniform(-3.0, 3.0, 3), random.uniform(-0.1, 0.1, 3)
        driver = Driver(company([entry for entry, _, _ in placed]))
        for tick in range(-5, COUNT):
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
