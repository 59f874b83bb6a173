"""`accuracy --meshes` and `--heightmap`: meshes and height maps converge to their surface at the theoretical order."""

import numpy as np
import pytest

from softfinger.tools.accuracy import meshes
from softfinger.tools.accuracy.meshes import CASES
from softfinger.tools.accuracy.pixels import HILLS, KINDS, compare, make_grid, make_paths

pytestmark = pytest.mark.plain
FINENESS = (8, 16, 32)
SHARPEST_M = {"ball": 0.05, "cylinder": 0.03, "torus": 0.02}
"""The smallest radius of curvature of each."""


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", CASES)
def test_a_surface_of_triangles_becomes_the_surface(name: str) -> None:
    """Halving the edges divides errors of the force, of the point's distance and of the rolled angle by four, since the
    height of a facet is quadratic in its size; errors of the direction and of the winding over a facet by two."""
    rows = list(meshes.converge(name, FINENESS))
    result = meshes.fit_orders(rows)
    assert result["force_n"] > 1.8 and result["point_m"] > 1.8
    # Where edges are crossed differs from mesh to mesh, so this slope scatters: 1.7 to 2.1. A loss at every edge has 1.
    assert result["rolled_m"] > 1.5 and 0.8 < result["direction_rad"] < 1.5 and result["wound_m"] > 0.7
    for row in rows:
        assert row["shaded_rad"] < 0.5 * row["direction_rad"]
        # A facet is tilted by at most its circumradius over R. Lost at every edge, it would be 0.3 to 0.5 mm.
        assert row["wound_m"] < meshes.DEPTH_M * row["edge_m"] / np.sqrt(3.0) / SHARPEST_M[name]
        assert row["shaded_step_rad"] < 0.5 * row["step_rad"]
        # A facet of that edge is at most so far off the surface, which the force feels at 1000 N/m.
        bulge = row["edge_m"] ** 2 / (4.0 * SHARPEST_M[name])
        assert row["point_m"] < bulge and row["force_n"] < 1000.0 * bulge


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", CASES)
def test_rolling_over_edges_does_not_depend_on_the_tick(name: str) -> None:
    """It comes from the mesh: an error of first order in the tick would be halved."""
    long, short = (
        next(meshes.converge(name, FINENESS[1:2], ticks))["rolled_m"] for ticks in (meshes.TICKS // 2, meshes.TICKS)
    )
    assert short == pytest.approx(long, rel=0.05)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", CASES)
def test_paths_go_askew_over_edges(name: str) -> None:
    """A path passes at least four facets, since errors at edges show only there. Its angles sum up to r d(theta) =
    |dc|, with c on the surface grown by r."""
    vertices, triangles = CASES[name].triangles(FINENESS[1])
    a, b, c = (vertices[triangles[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    for heading in meshes.HEADINGS_RAD:
        path = meshes.make_lead_path(CASES[name].shape, *meshes.find_start(CASES[name]), heading, meshes.TICKS)
        near = [int(np.linalg.norm((a + b + c) / 3.0 - point, axis=1).argmin()) for point in path.points[::20]]
        assert len(np.unique(normals[near].round(9), axis=0)) >= 4
        centers = path.points + meshes.RADIUS_M * path.normals
        travel = np.linalg.norm(np.diff(centers, axis=0), axis=1).sum()
        # Summed at the ends of ticks: off by half a tick's angle, at most.
        assert path.rolled[-1] == pytest.approx(travel / meshes.RADIUS_M, abs=0.5 * meshes.TURN_RAD / meshes.TICKS)


def test_triangles_are_wound_outward_and_join() -> None:
    for name in ("ball", "torus"):
        vertices, triangles = CASES[name].triangles(8)
        edges = [tuple(edge) for t in triangles.tolist() for edge in ((t[0], t[1]), (t[1], t[2]), (t[2], t[0]))]
        assert len(set(edges)) == len(edges) and {(b, a) for a, b in edges} == set(edges)
        a, b, c = (vertices[triangles[:, i]] for i in range(3))
        volume = float((a * np.cross(b, c)).sum() / 6.0)
        true = {"ball": 4.0 / 3.0 * 0.05**3 * 3.14159, "torus": 2.0 * 3.14159**2 * 0.05 * 0.02**2}[name]
        assert 0.9 * true < volume < true


def test_the_paths_lie_on_the_hills() -> None:
    """They satisfy the surface's equation, and their normals are its gradient, by differences."""
    for path in make_paths(20):
        x, y, z = path.points.T
        np.testing.assert_allclose(z, HILLS.height(x, y), rtol=0, atol=1e-12)
        step = 1e-5
        slopes = [(HILLS.height(x + step * a, y + step * b) - HILLS.height(x - step * a, y - step * b)) / (2 * step)
                  for a, b in ((1, 0), (0, 1))]  # fmt: skip
        up = np.stack([-slopes[0], -slopes[1], np.ones_like(x)], axis=1)
        # Differences of the second order: k^3 A step^2 / 6 is 8e-8.
        np.testing.assert_allclose(path.normals, up / np.linalg.norm(up, axis=1)[:, None], rtol=0, atol=1e-7)
        assert np.linalg.norm(path.points[-1] - path.points[0]) > meshes.RADIUS_M


def test_rows_of_the_array_have_the_heights_of_their_places() -> None:
    """The middle is the origin, columns lie along x."""
    _, _, z = make_grid(0.01)
    assert z.shape == (13, 13) and z[6, 6] == HILLS.amplitude
    assert z[6, 7] == pytest.approx(HILLS.height(0.01, 0.0)) and z[7, 6] == pytest.approx(HILLS.height(0.0, 0.01))


@pytest.mark.exhaustive
def test_a_height_map_is_of_higher_order_than_a_mesh_of_its_pixels() -> None:
    """Halving the pitch shows orders four and three for heights and slopes of the spline, two and one for triangles."""
    ways = make_paths(1000)
    errors = {(kind, pitch): compare(kind, pitch, ways) for kind in KINDS for pitch in (0.004, 0.002)}

    def order(kind: str, measure: str) -> float:
        return float(np.log2(errors[kind, 0.004][measure] / errors[kind, 0.002][measure]))

    assert order("heightmap", "force_n") > 3.5 and order("heightmap", "direction_rad") > 2.5
    assert 1.5 < order("mesh", "force_n") < 2.5 and 0.8 < order("mesh", "direction_rad") < 1.5
    for pitch in (0.004, 0.002):
        for measure in ("force_n", "direction_rad", "wound_m"):
            assert errors["heightmap", pitch][measure] < 0.05 * errors["mesh", pitch][measure]
