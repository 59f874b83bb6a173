"""Invariants for every input, tested with random cases that Hypothesis shrinks."""

import functools

import numpy as np
import pytest
from helpers import touching
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st
from references.laws import K_Z, axis_angles, stored_energy, work_of_the_hand
from references.rotation import matrix, multiply, quaternion

from softfinger.config.load import build
from softfinger.config.schema import Scene
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.numerics import rotations

pytestmark = [pytest.mark.plain, pytest.mark.scaled]

R = 0.01
GRIP = touching.GRIP | {"damping_ns_per_m": 1.0}
SLICK = {"stiffness_n_per_m": 1000.0}
TURNED = [0.8, 0.36, 0.48, 0.0]
BLOCK_POSE = {"position_m": [-0.03, 0.01, 0.0], "orientation_wxyz": TURNED}
HALF = np.array([0.02, 0.015, 0.01])


def numbers(rows, columns):
    """Arrays (rows, columns) in [-1, 1), 0 the simplest; a draw for each number would take longer than the test."""
    count = rows * columns
    return st.binary(min_size=2 * count, max_size=2 * count).map(
        lambda data: np.frombuffer(data, np.int16).reshape(rows, columns) / 32768.0
    )


def scene(kind, material="grip"):
    stuff = {"grip": GRIP, "slick": SLICK, "springs": GRIP | {"damping_ns_per_m": 0.0}}[material]
    ball = {"name": "ball", "shape": "sphere", "radius_m": 0.02, "material": stuff}
    objects = {
        "zoo": [
            {"name": "floor", "shape": "plane", "position_m": [0, 0, -0.02], "material": stuff},
            ball | {"position_m": [0.03, 0.0, 0.0]},
            {"name": "block", "shape": "box", "size_m": (2 * HALF).tolist(), "material": stuff} | BLOCK_POSE,
        ],
        "ball": [ball],
        "hollow ball": [ball | {"radius_m": 0.05, "inside": True}],
        "rod": [ball | {"shape": "cylinder"}],
        "floor": [{"name": "floor", "shape": "plane", "material": stuff}],
    }[kind]
    tables = {
        "grip": {"rolling": {"method": "euler_zxz"}},
        "slick": {},
        "springs": {"rolling": {"method": "rotation_vector"}, "coupling": {"damping_ns_per_m": 0.0}},
    }[material]
    return build(Scene, {"fingertip": {"radius_m": R}, "object": objects, **tables}, "invariants")


@functools.cache
def engine(kind, material="grip"):
    return Engine(scene(kind, material))


def gaps(x):
    """Return distances (3, n) of points (n, 3) from the zoo's objects, by independent formulas."""
    local = (x - BLOCK_POSE["position_m"]) @ matrix(TURNED)
    beyond = np.abs(local) - HALF
    block = np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)
    return np.array([x[:, 2] + 0.02, np.linalg.norm(x - np.array([0.03, 0.0, 0.0]), axis=1) - 0.02, block])


def visits(start, draws):
    """Poses (n + 1, 7): `start`, then a point within 60 mm for each row (n, 6), turned by up to 0.1 rad."""
    orientations, _ = walk(np.vstack([np.zeros(3), 0.1 * draws[:, 3:]]), len(draws) + 1)
    return np.hstack([np.vstack([start, 0.06 * draws[:, :3]]), orientations])


def visit(running, poses):
    running.reset()
    return running.run(poses)


ABOVE = (0.0, 0.0, 0.055)
"""Outside of all objects: a proxy that starts inside an object stays inside."""


@examples(50)
@given(numbers(6, 6), st.integers(1, 6))
def test_proxy_is_never_inside_any_object(draws, count):
    # The solver stops at 1e-10 of the radius; these formulas round, too.
    assert gaps(visit(engine("zoo"), visits(ABOVE, draws[:count]))["proxy.position"]).min() > R * (1.0 - 1e-9)


@examples(50)
@given(numbers(6, 6), st.integers(1, 6))
def test_force_is_within_the_friction_cone_and_never_pulls(draws, count):
    """The torsional moment is within its limit, too."""
    records = visit(engine("ball"), visits(0.06 * draws[0, :3], draws[:count]))
    normal = records["contact.normal_force"]
    assert (normal >= 0.0).all()
    assert (records["contact.tangential_force"] <= 0.6 * normal * (1.0 + 1e-9) + 1e-15).all()
    moment = np.sum(records["torque"] * records["contact.normal"], axis=1)
    assert (np.abs(moment) <= 0.004 * normal * (1.0 + 1e-9) + 1e-15).all()


NODES, WEIGHTS = np.polynomial.legendre.leggauss(12)
AXES = {"ball": (1.0, 1.0, 1.0), "hollow ball": (1.0, 1.0, 1.0), "rod": (1.0, 1.0, 0.0)}
"""Coordinates used for the distance from the centre or the axis."""
REACH = {"ball": 0.03, "hollow ball": 0.04, "rod": 0.03}
"""That distance at first contact, m: the sum of the radii, or their difference inside."""


def legs_of_force(running, corners, which, reach):
    """Return the work (n,), J, of the rendered force on the hand along each side of a closed polyline with n corners
    (n, 3).

    Gauss's rule between the points at which a side crosses the surface of first contact. The path stays 0.6 reach away
    from the centre and a piece is at most 0.7 reach long, so the force is analytic in an ellipse around a piece whose
    semi-axes sum to 3.67, and the error of 12 nodes is about 3.67^-24 = 3e-14 of the work.
    """
    ways = np.roll(corners, -1, axis=0) - corners
    squares, rests = np.sum(which * ways**2, axis=1), np.sum(which * corners**2, axis=1) - reach**2
    halves = np.sum(which * ways * corners, axis=1)
    pieces = []
    for side, (square, half, rest) in enumerate(zip(squares.tolist(), halves.tolist(), rests.tolist(), strict=True)):
        root = max(half * half - square * rest, 0.0) ** 0.5
        cuts = [t for t in ((-half - root) / square, (-half + root) / square) if 0.0 < t < 1.0] if square > 0.0 else []
        pieces += [(side, begin, end) for begin, end in zip([0.0, *cuts], [*cuts, 1.0], strict=True)]
    sides, begins, ends = (np.array(values) for values in zip(*pieces, strict=True))
    shares = begins[:, None] + 0.5 * (ends - begins)[:, None] * (NODES + 1.0)
    poses = np.tile([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], (shares.size, 1))
    poses[:, :3] = (corners[sides, None] + shares[:, :, None] * ways[sides, None]).reshape(-1, 3)
    running.reset()
    force = running.run(poses)["force"].reshape(*shares.shape, 3)
    work = np.einsum("pni,n,pi->p", force, WEIGHTS, 0.5 * (ends - begins)[:, None] * ways[sides])
    return np.bincount(sides, work, len(corners))


@pytest.mark.sampled(2)
@pytest.mark.parametrize("kind", list(REACH))
def test_closed_cycle_of_a_frictionless_contact_creates_no_energy(kind):
    """Around a random closed polyline the force does no work, and on each side the decrease of K depth^2 / 2."""
    running, reach, which = engine(kind, "slick"), REACH[kind], np.array(AXES[kind])

    @examples(20)
    @given(numbers(6, 3), st.integers(4, 6))
    def check(draws, count):
        # All corners are in a ball of 0.35 reach around a point at 0.95 reach: partly in contact, never near the
        # centre.
        toward = draws[0] * which
        size = np.linalg.norm(toward)
        middle = 0.95 * reach * (toward / size if size > 0.0 else np.array([1.0, 0.0, 0.0]))
        corners = middle + 0.35 * reach * draws[1:count] / np.sqrt(3.0)
        depth = reach - np.sqrt(np.sum(which * corners**2, axis=1))
        energy = 0.5 * 1000.0 * np.maximum(-depth if kind == "hollow ball" else depth, 0.0) ** 2
        work = legs_of_force(running, corners, which, reach)
        # Forces up to 16 N along sides up to 28 mm, with the error of the rule above and rounding.
        assert np.abs(work - energy + np.roll(energy, -1)).max() < 2e-14 and abs(work.sum()) < 4e-14

    check()


def cycle(at, goals, turns, ticks=8):
    """Poses (n, 7) from `at` (3,) to each goal (3,), rotating by these vectors in `ticks` ticks each, and back."""
    x, q, shares = at, np.array([1.0, 0.0, 0.0, 0.0]), np.arange(1, ticks + 1)[:, None] / ticks
    poses = [np.concatenate([x, q])[None]]
    for goal, turned in [*zip(goals, turns, strict=True), (at, None)]:
        if turned is None:  # rotate back to the initial orientation
            (turned,) = axis_angles(np.array([q, [1.0, 0.0, 0.0, 0.0]]))
        orientations = multiply(quaternion(shares * turned), q)
        poses.append(np.hstack([x + shares * (goal - x), orientations]))
        x, q = goal, orientations[-1]
    return np.concatenate(poses)


@examples(40)
@given(numbers(4, 6), st.integers(1, 4))
def test_closed_cycle_on_a_plane_with_friction_creates_no_energy(draws, count):
    """The work of the hand is at least the energy stored in the springs: exact for any time step if the motion of each
    tick is multiplied by the wrench at its end, since the springs' energy is convex and slip is towards the probe."""
    running = engine("floor", "springs")
    running.reset()
    goals = np.array([0.0, 0.0, R - 0.001]) + draws[:count, :3] * [0.004, 0.004, 0.002]
    records = running.run(cycle(np.array([0.0, 0.0, R + 0.002]), goals, 0.3 * draws[:count, 3:]))
    # Sums of up to forty terms of up to 1e-2 J.
    assert (work_of_the_hand(records) - stored_energy(records)).min() > -1e-14


@examples(40)
@given(numbers(4, 6), st.integers(1, 4))
def test_closed_cycle_on_a_ball_with_friction_gives_no_energy(draws, count):
    """The same on a ball, up to the rotation of the normal within a tick: the proxy moves by l = |slip| + r |turn|, the
    normal rotates by up to l / D with D the sum of the radii, and a tangent displacement deviates from the surface by
    l^2 / D. The balance has an error of up to the force times l^2 / D, the moment times the turn times l / D, and K / 2
    times (l^2 / D)^2."""
    running, reach = engine("ball", "springs"), R + 0.02
    running.reset()
    outward = np.array([0.0, 0.0, reach]) + draws[:count, :3] * [0.004, 0.004, 0.0]
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    goals = outward * (reach - 0.001 + 0.002 * draws[:count, 2:3])
    records = running.run(cycle(np.array([0.0, 0.0, reach + 0.002]), goals, 0.3 * draws[:count, 3:]))
    turned = np.linalg.norm(axis_angles(records["probe.orientation"]), axis=1)
    travel = np.linalg.norm(np.diff(records["proxy.position"], axis=0), axis=1) + R * turned
    force = np.linalg.norm(records["force"], axis=1)[1:]
    moment = np.abs(K_Z * records["contact.spin"])[1:]
    missed = np.cumsum((force * travel + moment * turned) * travel / reach + 0.5 * 1000.0 * (travel**2 / reach) ** 2)
    assert ((work_of_the_hand(records) - stored_energy(records))[1:] + missed).min() > -1e-14


@examples(40)
@given(numbers(6, 6), st.integers(1, 6))
def test_finger_side_point_follows_exactly_from_the_orientation(draws, count):
    """The contact point on the fingertip is -r R^T n, so it cannot drift."""
    records = visit(engine("zoo"), visits(0.06 * draws[0, :3], draws[:count]))
    for record in records[records["contact.mode"] > 0.0]:
        normal, finger = record["contact.normal"], record["contact.finger_point"]
        turn = matrix(record["probe.orientation"])
        assert np.abs(finger + R * turn.T @ normal).max() <= 1e-16 * 10
        assert np.abs(record["proxy.position"] + turn @ finger - record["contact.point"]).max() <= 1e-15
        assert abs(np.linalg.norm(normal) - 1.0) < 1e-14


anything = st.floats(-1e6, 1e6)
any_quaternion = st.tuples(*[st.floats(-1e6, 1e6)] * 4).filter(lambda q: 1e-6 <= np.linalg.norm(q) <= 1e6)
any_dt = st.one_of(st.just(0.0), st.floats(1e-9, 1e3))


@examples(50)
@given(st.lists(st.tuples(st.tuples(anything, anything, anything), any_quaternion, any_dt), min_size=1, max_size=4))
def test_finite_input_gives_finite_output(ticks):
    running = engine("zoo")
    running.reset()
    for position, orientation, dt in ticks:
        assert np.isfinite(running.run([[*position, *orientation]], dt)).all()


@entry
def as_matrices(quaternions, out):
    for i in range(quaternions.shape[0]):
        q = rotations.normalize((quaternions[i, 0], quaternions[i, 1], quaternions[i, 2], quaternions[i, 3]))
        for k in range(3):
            axis = (1.0 if k == 0 else 0.0, 1.0 if k == 1 else 0.0, 1.0 if k == 2 else 0.0)
            out[i, 0, k], out[i, 1, k], out[i, 2, k] = rotations.rotate(q, axis)


@entry
def walk_by(turns, steps, out):
    """Orientations (n, 4) from rotation vectors (n, 3), and `relative` of each to the one before."""
    q = (1.0, 0.0, 0.0, 0.0)
    for i in range(turns.shape[0]):
        before = q
        turn = rotations.exp((turns[i, 0], turns[i, 1], turns[i, 2]))
        q = rotations.normalize(rotations.multiply(turn, before))
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = q
        steps[i, 0], steps[i, 1], steps[i, 2], steps[i, 3] = rotations.relative(q, before)


def walk(turns, ticks):
    """Return orientations (ticks, 4) from rotation vectors (n, 3), repeated, and the steps between them (ticks, 4)."""
    orientations, steps = np.empty((ticks, 4)), np.empty((ticks, 4))
    walk_by(np.resize(turns, (ticks, 3)), steps, orientations)
    return orientations, steps


ULP = np.finfo(float).eps


def assert_rotations(matrices):
    """R^T R = 1 and det R = +1: an entry has ten operations on numbers up to 2, each to half an ulp."""
    assert np.abs(np.swapaxes(matrices, 1, 2) @ matrices - np.eye(3)).max() <= 16 * ULP
    assert np.abs(np.linalg.det(matrices) - 1.0).max() <= 24 * ULP


def matrices_of(quaternions):
    out = np.empty((len(quaternions), 3, 3))
    as_matrices(np.ascontiguousarray(quaternions, float), out)
    return out


@examples(150)
@given(numbers(1, 4), st.floats(-6.0, 6.0))
def test_any_quaternion_gives_a_rotation_matrix(draws, exponent):
    if not draws.any():
        return
    q = 10.0**exponent * draws / np.linalg.norm(draws)
    matrices = matrices_of(q)
    assert_rotations(matrices)
    np.testing.assert_allclose(matrices[0], matrix(q[0]), atol=16 * ULP)


@examples(50)
@given(numbers(3, 3), st.integers(1, 300))
def test_a_sequence_of_rotations_stays_normalised(draws, ticks):
    orientations, steps = walk(3.0 * draws, ticks)
    # One product and one normalisation of a unit quaternion per tick; a step is the product of two unit quaternions.
    assert np.abs(np.linalg.norm(orientations, axis=1) - 1.0).max() <= 4 * ULP
    assert np.abs(np.linalg.norm(steps, axis=1) - 1.0).max() <= 8 * ULP and (steps[:, 0] >= 0.0).all()
    assert_rotations(matrices_of([orientations[-1], steps[-1]]))
