"""Several objects, thin objects and moving objects: the proxy is the nearest point outside all of them."""

from functools import partial
from itertools import permutations

import numpy as np
import pytest
from helpers import touching
from helpers.touching import R, facing, visit, wall
from scipy.optimize import nnls

from softfinger.proxy.kernels.contact.rest.active_set import is_enclosed
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.model import Constraint
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.half_spaces import FACING_COSINE, solve_half_spaces
from softfinger.proxy.record import AT

pytestmark = pytest.mark.plain

SLICK = {"stiffness_n_per_m": 1000.0}
engine = partial(touching.engine, rolling=None)


def make_object(name, shape, position=(0.0, 0.0, 0.0), **keys):
    return {"name": name, "shape": shape, "position_m": list(position), "material": SLICK, **keys}


@pytest.mark.sampled(2)
@pytest.mark.parametrize("angle", [30.0, 60.0, 90.0, 120.0, 150.0])
def test_groove_is_the_nearest_point_to_the_probe(angle):
    """Between two walls at any angle the proxy is the foot of the probe on the groove's centre line, in closed form."""
    half = np.radians(angle) / 2.0
    n1, n2 = np.array([np.cos(half), 0.0, np.sin(half)]), np.array([-np.cos(half), 0.0, np.sin(half)])
    groove = engine(wall("one", n1), wall("two", n2))
    height = R / np.sin(half)  # centre of the sphere that touches both
    records = visit(groove, np.linspace((0.0005, 0.0, height + 0.005), (0.0005, 0.003, height - 0.002), 400))
    final = np.array([0.0005, 0.003, height - 0.002])
    inside = [R - n @ final for n in (n1, n2)]
    assert min(inside) > 0.0
    np.testing.assert_allclose(records["proxy.position"][-1], [0.0, 0.003, height], atol=1e-12)


def test_the_first_of_two_walls_changes_only_where_another_bears_clearly_more():
    """A difference of 1 nm in depth causes no switch, twice the load does, and equal depths do not switch back."""
    floor, left_wall = 0, 1
    corner = engine(wall("floor", (0, 0, 1)), wall("left", (1, 0, 0)))
    begin = np.linspace((0.02, 0.0, R - 0.001), (R - 0.0005, 0.0, R - 0.001), 100)
    alike = [(R - 0.001 + sign * 1e-9, 0.0, R - 0.001) for sign in (-1.0, 1.0)] * 10
    more = [(R - 0.002, 0.0, R - 0.001)]
    records = visit(corner, np.vstack([begin, alike, more, alike]))
    first = records["contact.object"].tolist()
    assert first[len(begin) - 1 :] == [floor] * 21 + [left_wall] * 21
    np.testing.assert_allclose(records["force"][-1], [1.0, 0.0, 1.0], atol=2e-6)  # 1000 N/m times 1 nm


def test_sphere_rests_between_three_spheres():
    corners = [np.array([0.012 * np.cos(a), 0.012 * np.sin(a), 0.0]) for a in np.radians([0.0, 120.0, 240.0])]
    balls = [make_object(f"ball {i}", "sphere", p.tolist(), radius_m=0.01) for i, p in enumerate(corners)]
    height = np.sqrt(0.02**2 - 0.012**2)
    target = (0.0003, 0.0002, height - 0.001)
    records = visit(engine(*balls), np.vstack([np.linspace((0.0, 0.0, 0.03), target, 300), [target] * 20]))
    at = records["proxy.position"][-1]
    np.testing.assert_allclose([np.linalg.norm(at - p) for p in corners], 0.02, atol=1e-12)
    np.testing.assert_allclose(at, [0.0, 0.0, height], atol=1e-12)


@pytest.mark.parametrize(
    ("shape", "keys"),
    [
        ("box", {"size_m": [0.2, 0.2, 0.001]}),
        ("sphere", {"radius_m": 0.0005}),
        ("capsule", {"radius_m": 0.0005, "length_m": 0.1, "orientation_wxyz": facing((0, 1, 0))}),
        ("cylinder", {"radius_m": 0.0005, "length_m": 0.1, "orientation_wxyz": facing((0, 1, 0))}),
        ("ellipsoid", {"semi_axes_m": [0.05, 0.05, 0.0005]}),
        ("torus", {"major_radius_m": 0.02, "minor_radius_m": 0.0005}),
    ],
)
@pytest.mark.parametrize("tilt", [0.0, 0.1])
def test_thin_object_is_not_jumped_over(shape, keys, tilt):
    passing = engine(make_object("thin", shape, (-0.02, 0.0, 0.0) if shape == "torus" else (0.0, 0.0, 0.0), **keys))
    start, end = np.array([tilt * 0.05, 0.0, 0.05]), np.array([-tilt * 0.05, 0.0, -0.05])
    records = visit(passing, [start, start, end, end, end])
    assert (records[2:, AT.contact_mode] != 0).all() and records["proxy.position"][2][2] > 0.0
    assert (records["force"][2:, 2] > 1.0).all()


def test_second_thin_wall_is_not_passed_while_the_first_is_touched():
    plates = [
        make_object("plate", "box", size_m=[0.2, 0.2, 0.001]),
        make_object("fence", "box", (0.05, 0, 0.05), size_m=[0.001, 0.2, 0.1]),
    ]
    records = visit(engine(*plates), [(0.0, 0.0, 0.03)] * 2 + [(0.0, 0.0, 0.008)] + [(0.09, 0.0, 0.008)] * 2)
    np.testing.assert_allclose(records["proxy.position"][-1], [0.05 - 0.0005 - R, 0.0, 0.0005 + R], atol=1e-9)


def test_inside_of_a_box_is_a_corner_too():
    """In the corner of a hollow box, three walls push with K times their depths."""
    room = engine(make_object("room", "box", size_m=[0.1, 0.1, 0.1], inside=True))
    goal = (0.042, 0.043, -0.044)
    records = visit(room, np.vstack([np.linspace((0.0, 0.0, 0.0), goal, 300), [goal] * 3]))
    np.testing.assert_allclose(records["proxy.position"][-1], [0.04, 0.04, -0.04], atol=1e-12)
    np.testing.assert_allclose(records["force"][-1], [-2.0, -3.0, 4.0], atol=1e-9)
    assert records[-1, AT.contact_object] == 0


def test_turning_table_spins_the_contact():
    motion = {"kind": "turntable", "axis": [0.0, 0.0, 1.0], "rate_rad_per_s": 0.5}
    table = make_object("table", "plane", material=touching.GRIP, motion=motion)
    records = visit(engine(table), [(0.0, 0.0, 0.009)] * 101)
    # In the 100 ticks after the touch the table turns by 0.05 rad, so the finger turns by -0.05 rad relative to it.
    np.testing.assert_allclose(records[-1, AT.contact_spin], -0.05, rtol=1e-9)
    np.testing.assert_allclose(records[-1, AT.torque + 2], 0.0025, rtol=1e-9)


@pytest.mark.scaled
def test_proxy_never_oscillates_at_rest(cases):
    rng = np.random.default_rng(5)
    ball = make_object("ball", "sphere", (0.02, 0.01, 0.01), radius_m=0.012)
    clutter = [wall("floor", (0, 0, 1)), wall("left", (1, 0, 0)), ball]
    for _ in range(cases(4, 20)):
        target = rng.uniform([-0.003, -0.01, -0.003], [0.02, 0.02, 0.012])
        records = visit(engine(*clutter), np.vstack([np.linspace((0.05, 0.0, 0.05), target, 100), [target] * 60]))
        moved = np.linalg.norm(np.diff(records["proxy.position"][-50:], axis=0), axis=1)
        # Each step is at most as long as the one before, to rounding; near a medial axis convergence takes longer.
        assert (moved[1:] <= moved[:-1] + 1e-15).all(), target
        assert moved[-1] < 1e-6, target


@entry
def solve(count, n1, n2, n3, b1, b2, b3):
    solution = solve_half_spaces(count, n1, n2, n3, b1, b2, b3)
    return solution.push, vec3.weighted_sum(solution.weights, n1, n2, n3)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("count", [1, 2, 3])
def test_agrees_with_non_negative_least_squares(count):
    rng = np.random.default_rng(count)
    for _ in range(2000):
        normals = rng.normal(size=(3, 3))
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        if count == 3 and abs(np.linalg.det(normals)) < 1e-3:
            continue  # nearly coplanar normals: both solutions are accurate to fewer digits
        if any(normals[i] @ normals[j] < FACING_COSINE for i in range(count) for j in range(i)):
            continue  # walls that face each other are a pinch
        deflection = rng.normal(size=3)  # c - x
        _, d = solve(count, *map(tuple, normals.tolist()), *(normals @ deflection).tolist())
        weights, _ = nnls(normals[:count].T, deflection)
        # The condition of the Gram matrix at a determinant of 1e-3 costs up to six digits of sixteen.
        np.testing.assert_allclose(d, normals[:count].T @ weights, atol=1e-9)


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_between_walls_that_face_each_other_is_halfway(order):
    normals, demands = [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (-1.0, 0.0, 0.0)], [0.002, 0.003, 0.001]
    push, d = solve(3, *(normals[i] for i in order), *(demands[i] for i in order))
    np.testing.assert_allclose(d, (0.001, 0.0, 0.002), atol=1e-15)
    np.testing.assert_allclose(push, [demands[i] for i in order], atol=1e-15)


@entry
def are_enclosing(n1, n2, n3):
    return is_enclosed((Constraint(0.0, n1, 1e-3), Constraint(1.0, n2, 1e-3), Constraint(2.0, n3, 1e-3)))


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_walls_that_face_each_other_enclose_the_proxy_in_any_order(order):
    for angle, expected in ((0.15, True), (0.25, False)):  # rad from exactly facing; the limit is arccos(0.98) = 0.20
        normals = [(0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (-np.cos(angle), np.sin(angle), 0.0)]
        assert are_enclosing(*(normals[i] for i in order)) == expected


@pytest.mark.scaled
@pytest.mark.parametrize("count", [4, 9])
def test_a_pit_of_many_walls_is_the_nearest_point(count, cases):
    """Least distance programming by non-negative least squares: Lawson and Hanson, Solving Least Squares Problems, 23.

    In the pit 297 of nine walls, the weakest of three walls is needed when a fourth obstructs the proxy.
    """
    down, wander = np.linspace(0.04, -0.02, 30)[:, None] * [0.0, 0.0, 1.0], 0.25 * np.arange(40)[:, None]
    for seed in (297, *range(cases(3, 40))):
        rng = np.random.default_rng([count, seed])
        normals = rng.normal(size=(count, 3)) * [1.0, 1.0, 0.0] + [0.0, 0.0, 0.5]
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        offsets = rng.normal(size=count) * 5e-3
        pit = engine(*[wall(f"wall {i}", n, offset=b) for i, (n, b) in enumerate(zip(normals, offsets, strict=True))])
        probes = np.vstack([down, down[-1] + 0.02 * np.sin(wander * rng.uniform(0.5, 2.0, 3))])
        records = visit(pit, probes)
        assert (records["contact.budget"] == 0).all()
        for probe, proxy in zip(probes[30:], records["proxy.position"][30:], strict=True):
            system, target = np.vstack([normals.T, R + offsets - normals @ probe]), np.array([0.0, 0.0, 0.0, 1.0])
            residual = system @ nnls(system, target)[0] - target
            np.testing.assert_allclose(proxy - probe, -residual[:3] / residual[3], atol=1e-9)


def test_a_demand_met_by_another_wall_gets_no_weight():
    slanted = (0.6, 0.0, 0.8)
    push, d = solve(2, (0.0, 0.0, 1.0), slanted, slanted, 1.0, 0.5, 0.0)
    assert push == (1.0, 0.0, 0.0) and d == (0.0, 0.0, 1.0)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-7, 2e-6, 1e-5, 3e-5, 1e-4, 2e-3])
def test_nearly_parallel_walls_push_as_one(angle):
    """The sideways part of the second demand adds at most the difference of the demands."""
    up, tilted = (0.0, 0.0, 1.0), (float(np.sin(angle)), 0.0, float(np.cos(angle)))
    for more in (0.0, 1e-18, -1e-18, 1e-12, -1e-12, 1e-9, -1e-9):
        for normals, demands in (((up, tilted, up), (0.04, 0.04 + more)), ((tilted, up, up), (0.04 + more, 0.04))):
            for count in (2, 3):
                push, d = solve(count, *normals, *demands, 0.04)
                assert min(push) >= 0.0
                # A demand may be missed by 1e-9 of itself if the normals are almost parallel.
                for n, b in zip(normals, demands, strict=False):
                    assert np.dot(n, d) > b - 1e-10
                assert sum(push) < max(*demands) + 0.04 * angle**2 + abs(more) + 1e-10


def test_parallel_and_opposite_normals_give_finite_weights():
    up, down = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
    assert solve(2, up, up, up, 1.0, 1.0, 0.0)[1] == (0.0, 0.0, 1.0)
    push, d = solve(2, up, down, up, 1.0, 0.5, 0.0)
    assert push == (1.0, 0.5, 0.0) and d == (0.0, 0.0, 0.25)
    assert np.isfinite(solve(3, up, down, (1.0, 0.0, 0.0), 1.0, 1.0, 1.0)[1]).all()
