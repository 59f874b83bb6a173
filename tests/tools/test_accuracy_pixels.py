"""`accuracy --heightmap`: accuracy of the smooth surface of a height map compared with a mesh of the same pixels."""

import numpy as np
import pytest

from softfinger.tools.accuracy.meshes import RADIUS_M
from softfinger.tools.accuracy.pixels import HILLS, KINDS, compare, make_grid, make_paths

pytestmark = pytest.mark.plain


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
        assert np.linalg.norm(path.points[-1] - path.points[0]) > RADIUS_M


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
