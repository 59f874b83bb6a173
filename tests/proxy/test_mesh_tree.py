"""Queries of the nearest triangle of a mesh, compared with a brute-force search by an independent formula."""

import numpy as np
import pytest
from helpers import meshes
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st
from references.triangles import distances

from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.jit.rows import Rows
from softfinger.proxy.kernels.model import Mesh, Triangles
from softfinger.proxy.kernels.shapes.budget import BUDGET, NO_BUDGET, QUEUE_SIZE
from softfinger.proxy.kernels.shapes.mesh import contact, triangle
from softfinger.proxy.kernels.shapes.mesh import nearest as query
from softfinger.proxy.kernels.shapes.mesh.contact import NO_TRIANGLE
from softfinger.proxy.kernels.shapes.mesh.lanes import FIELDS, LANES
from softfinger.proxy.kernels.shapes.mesh.nearest import MAX_HOLLOW_EDGES, POOR_CANDIDATE_VISITS
from softfinger.proxy.meshes.tree import Tree, build_tree

WHOLE = QUEUE_SIZE
"""The largest budget: only the query from the middle of a sphere uses it up."""
EQUAL = 1e-9
"""Allowed difference of two float64 distances, relative to the mesh size: both formulas lose digits on slivers."""


@entry
def nearest(mesh, x, limit, known, budget, enough):
    """Entry point that is cached on disk, unlike the inlined kernel it calls."""
    return query.find_nearest(mesh, x, limit, known, budget, enough)


@entry
def nearest_facet(mesh, x, within, known, budget, enough):
    return contact.find_nearest_facet(mesh, x, within, known, budget, enough)


@entry
def closest_on_triangle(mesh, number, x):
    return triangle.closest_on_triangle(mesh, number, x)


def mesh_of(tree: Tree, side: float = 1.0, shade: float = 0.0) -> Mesh:
    arrays = (ReadOnly(array) for array in tree[:6])
    x, y, z = tree.center.tolist()
    count = float(len(tree.corners))
    return Mesh(Rows([Triangles(*arrays, count, (x, y, z), tree.size, side if tree.closed else 0.0, shade)]))


def soup(rng, count, size):
    middle = rng.normal(size=(count, 1, 3)) * size
    spread = rng.normal(size=(count, 3, 3)) * size * 10.0 ** rng.uniform(-6.0, 0.0, (count, 1, 1))
    return (middle + spread).reshape(-1, 3), np.arange(3 * count, dtype=np.int32).reshape(-1, 3)


CASES = {
    "one": (np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]), np.array([[0, 1, 2]], np.int32)),
    "nine": soup(np.random.default_rng(1), 9, 1.0),
    "ball": meshes.geodesic(12, 0.05),
    "torus": meshes.torus(0.05, 0.02, 40, 24),
    "bumpy": meshes.bumpy_sphere(20, 0.05),
    "moebius": meshes.moebius(0.05, 0.02),
    "sheet": meshes.sheet(0.2, 0.1, 30, 20),
    "cylinder": meshes.cylinder(0.02, 0.1, 48, 7),
    "soup": soup(np.random.default_rng(2), 3000, 0.1),
    "far": meshes.moved(meshes.geodesic(8, 1e-6), (3.0, -2.0, 1.0)),
    "folded": (np.zeros((300, 3)) + np.array([[1.0, 2.0, 3.0]]), np.arange(300, dtype=np.int32).reshape(-1, 3)),
}


@pytest.mark.sampled(4)
@pytest.mark.parametrize("name", CASES)
def test_distance_equals_the_brute_force_minimum(name):
    vertices, triangles = CASES[name]
    tree = build_tree(np.asarray(vertices, float), np.asarray(triangles, np.int32))
    mesh, rng = mesh_of(tree), np.random.default_rng(3)
    size, middle = max(tree.size, 1e-9), np.asarray(vertices).mean(axis=0)
    on = np.asarray(vertices)[np.asarray(triangles)[rng.integers(0, len(triangles), 60)]].mean(axis=1)
    points = np.concatenate([middle + size * rng.normal(size=(60, 3)), on + 0.02 * size * rng.normal(size=(60, 3)), on])
    for x in points:
        expected = distances(np.asarray(vertices), np.asarray(triangles), x).min()
        spot = nearest(mesh, tuple(x.tolist()), 1e300, NO_TRIANGLE, WHOLE, 0.0)
        assert abs(np.sqrt(spot.squared_distance) - expected) <= EQUAL * size and spot.bound == spot.squared_distance
        gap, point, normal = closest_on_triangle(mesh, float(spot.triangle), tuple(x.tolist()))
        assert abs(abs(gap) - expected) <= EQUAL * size
        assert abs(np.linalg.norm(normal) - 1.0) < 1e-12
        assert np.linalg.norm(np.array(point) + gap * np.array(normal) - x) <= EQUAL * size


@examples(60, 200)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.floats(-6.0, 3.0), st.floats(0.1, 1e4))
def test_random_triangles_at_all_sizes(seed, count, exponent, away):
    rng, size = np.random.default_rng(seed), 10.0**exponent
    vertices, triangles = soup(rng, count, size)
    tree = build_tree(vertices, triangles)
    mesh = mesh_of(tree)
    x = away * size * rng.normal(size=3)
    spot = nearest(mesh, tuple(x.tolist()), 1e300, NO_TRIANGLE, WHOLE, 0.0)
    # Far away, float32 boxes resolve the distance only to 1e-6 of the mesh size.
    slack = EQUAL * (tree.size + np.linalg.norm(x)) + 1e-6 * tree.size * (away > 100.0)
    assert abs(np.sqrt(spot.squared_distance) - distances(vertices, triangles, x).min()) <= slack


def test_sign_of_the_gap_at_faces_edges_and_corners():
    """The gap is positive exactly outside; a mesh with side -1 gives the opposite gap and normal."""
    rng = np.random.default_rng(4)
    for made in (meshes.geodesic(3, 1.0), meshes.bumpy_sphere(6, 1.0, height=0.2)):
        tree = build_tree(*made)
        assert tree.closed
        outward, inward = mesh_of(tree), mesh_of(tree, side=-1.0)
        for _ in range(300):
            direction = rng.normal(size=3)
            direction /= np.linalg.norm(direction)
            # Distance at which the ray from the middle meets the surface; both meshes are star-shaped.
            a, b, c = (made.vertices[made.triangles[:, i]] for i in range(3))
            sides = np.stack([b - a, c - a, np.broadcast_to(-direction, a.shape)], axis=2)
            u, v, t = np.linalg.solve(sides, -a[:, :, None])[:, :, 0].T
            reach = t[(u >= -1e-12) & (v >= -1e-12) & (u + v <= 1.0 + 1e-12) & (t > 0.0)].max()
            x = tuple((reach * rng.choice([0.3, 0.9, 0.999, 1.001, 1.1, 3.0]) * direction).tolist())
            number = float(nearest(outward, x, 1e300, NO_TRIANGLE, WHOLE, 0.0).triangle)
            gap, point, normal = closest_on_triangle(outward, number, x)
            assert (gap > 0.0) == (np.linalg.norm(x) > reach)
            assert closest_on_triangle(inward, number, x) == (-gap, point, tuple(-component for component in normal))


def test_an_open_mesh_is_a_sheet_with_two_sides():
    tree = build_tree(*meshes.sheet(1.0, 1.0, 4, 4))
    assert not tree.closed
    for z in (0.3, -0.3):
        gap, point, normal = closest_on_triangle(mesh_of(tree), 3.0, (0.01, 0.02, z))
        assert gap > 0.0 and normal[2] * z > 0.0 and abs(point[2]) < 1e-12


def test_a_limit_and_known_triangles_change_no_answer():
    """A limit hides only triangles beyond it. Of equally near triangles, the query returns the known one."""
    tree = build_tree(*meshes.geodesic(10, 0.05))
    mesh, rng = mesh_of(tree), np.random.default_rng(5)
    for _ in range(200):
        x = rng.normal(size=3)
        x = tuple((0.06 * x / np.linalg.norm(x)).tolist())
        spot = nearest(mesh, x, 1e300, NO_TRIANGLE, WHOLE, 0.0)
        distance = np.sqrt(spot.squared_distance)
        assert nearest(mesh, x, distance * (1.0 - 1e-9), NO_TRIANGLE, WHOLE, 0.0).triangle == -1
        assert nearest(mesh, x, distance * (1.0 + 1e-9), NO_TRIANGLE, WHOLE, 0.0).squared_distance == pytest.approx(
            spot.squared_distance
        )
        for known in (float(spot.triangle), float(rng.integers(0, len(tree.corners)))):
            limited = nearest(mesh, x, 1e300, (known, -1.0, -1.0), WHOLE, 0.0)
            assert limited.squared_distance == pytest.approx(spot.squared_distance, rel=1e-9)
    corner = tree.vertices[0] * 1.2
    around = np.flatnonzero((tree.corners == 0).any(axis=1))
    for known in around:  # five or six are equally near
        assert nearest(mesh, tuple(corner.tolist()), 1.0, (float(known), -1.0, -1.0), WHOLE, 0.0).triangle == known


def test_an_exhausted_budget_still_gives_a_lower_bound():
    """From the middle of a sphere all triangles are equally near. The query overspends by at most one node."""
    vertices, triangles = meshes.geodesic(40, 0.05)
    mesh = mesh_of(build_tree(vertices, triangles))
    x = (1e-7, 2e-7, -1e-7)
    true = distances(vertices, triangles, np.array(x)).min()
    spot = nearest(mesh, x, 1e300, NO_TRIANGLE, BUDGET, 0.0)
    assert spot.visits <= BUDGET + 8 and spot.bound < spot.squared_distance
    assert 0.0 < np.sqrt(spot.bound) <= true <= np.sqrt(spot.squared_distance) + 1e-15
    assert nearest(mesh, x, 1e300, NO_TRIANGLE, WHOLE, 0.0).visits > 1.5 * BUDGET


def test_a_query_stops_early_at_a_triangle_within_reach():
    """Near the centre of a sphere many triangles are almost equally near."""
    vertices, triangles = meshes.geodesic(60, 0.05)
    tree = build_tree(vertices, triangles)
    mesh, x = mesh_of(tree), (1.2e-3, 0.7e-3, -0.9e-3)
    true = distances(vertices, triangles, np.array(x)).min()
    nearest_of_all = nearest(mesh, x, 1e300, NO_TRIANGLE, WHOLE, 0.0)
    assert np.sqrt(nearest_of_all.squared_distance) == pytest.approx(true, rel=1e-12)
    some = nearest(mesh, x, 1e300, NO_TRIANGLE, WHOLE, 0.05)
    assert some.bound == some.squared_distance < 0.05**2 and some.visits < 0.7 * nearest_of_all.visits
    apart = distances(tree.vertices, tree.corners[[some.triangle]], np.array(x))
    assert np.sqrt(some.squared_distance) == pytest.approx(float(apart.min()), rel=1e-12)
    assert nearest(mesh, x, 1e300, NO_TRIANGLE, WHOLE, true * (1.0 - 1e-9)) == nearest_of_all


def test_all_queries_of_a_tick_share_one_budget():
    mesh = mesh_of(build_tree(*meshes.geodesic(40, 0.05)))
    hard, easy, budget, total = (1e-3, 0.0, 0.0), (0.06, 0.0, 0.0), BUDGET, 0
    for _ in range(100):
        before = budget
        _, _, budget = nearest_facet(mesh, hard, 1e300, NO_TRIANGLE, budget, 0.0)
        if budget == NO_BUDGET:
            break
        spent = nearest(mesh, hard, 1e300, NO_TRIANGLE, before, 0.0).visits
        assert budget == max(before - spent, 0)
        total += spent
    assert budget == NO_BUDGET and 0 < total < BUDGET + POOR_CANDIDATE_VISITS + 3 * MAX_HOLLOW_EDGES
    assert nearest_facet(mesh, easy, 1e300, NO_TRIANGLE, BUDGET, 0.0)[2] > 0
    assert nearest_facet(mesh, easy, 1e300, NO_TRIANGLE, budget, 0.0)[2] == NO_BUDGET


def test_tree_contains_each_triangle_once():
    vertices, triangles = meshes.bumpy_sphere(15, 0.05)
    tree = build_tree(vertices, triangles)
    least, most = vertices.min(axis=0), vertices.max(axis=0)
    np.testing.assert_allclose(tree.center, 0.5 * (least + most), rtol=0.0, atol=1e-17)  # rounding of a few cm
    assert tree.size == pytest.approx(np.linalg.norm(most - least), rel=1e-15)
    counts = np.zeros(len(triangles), int)
    lanes = tree.nodes.reshape(-1, FIELDS, LANES).astype(float)

    def below(node):
        first = tree.first[node]
        numbers = []
        for lane in range(8):
            fields = lanes[node, :, lane]
            if fields[9] < 0.0:
                continue
            inside = [~first + lane] if first < 0 else below(first + lane)
            numbers += inside
            x = tree.vertices[tree.corners[inside]].reshape(-1, 3) - tree.center - fields[:3]
            up, side = fields[3:6], fields[6:9]
            assert abs(up @ side) < 1e-6
            for axis, half in zip((side, np.cross(up, side), up), fields[9:], strict=True):
                assert (np.abs(x @ axis) <= half).all()
            if first < 0:
                counts[inside] += 1
        return numbers

    assert len(below(0)) == len(triangles)
    assert (counts == 1).all()
    original = np.sort(vertices[triangles].sum(axis=1), axis=0)
    assert np.allclose(np.sort(tree.vertices[tree.corners].sum(axis=1), axis=0), original, rtol=0.0, atol=1e-15)
