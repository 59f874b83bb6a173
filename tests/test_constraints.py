"""The multi-contact solve against an independent quadratic programme."""

import numpy as np
import pytest
from scipy.optimize import nnls

from softfinger.proxy.kernels.constraints import displacement, smallest_push
from softfinger.proxy.kernels.jit import entry


@entry
def solve(count, n1, n2, n3, b1, b2, b3):
    push = smallest_push(count, n1, n2, n3, b1, b2, b3)
    return push, displacement(push, n1, n2, n3)


def unit(rng):
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


@pytest.mark.parametrize("count", [1, 2, 3])
def test_agrees_with_non_negative_least_squares(count):
    """For a goal x behind constraints through a point c, x + d is what Lawson and Hanson's method finds."""
    rng = np.random.default_rng(count)
    for _ in range(2000):
        normals = [unit(rng) for _ in range(3)]
        if count == 3 and abs(np.linalg.det(np.array(normals))) < 1e-3:
            continue  # nearly coplanar normals: both solutions are right to fewer digits
        deflection = rng.normal(size=3)  # c - x
        demands = [float(n @ deflection) for n in normals]
        _, d = solve(count, *[tuple(n.tolist()) for n in normals], *demands)
        weights, _ = nnls(np.array(normals[:count]).T, deflection)
        # The condition of the Gram matrix at a determinant of 1e-3 costs up to six digits of sixteen.
        np.testing.assert_allclose(d, np.array(normals[:count]).T @ weights, atol=1e-9)


def test_corner_of_a_box():
    """Three walls at right angles: every demand is met separately."""
    axes = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)]
    push, _ = solve(3, *axes, 1.0, 2.0, 3.0)
    assert push == (1.0, 2.0, 3.0)


def test_demand_that_another_meets_gets_no_weight():
    """A wall that is satisfied by the push from the floor carries no force."""
    slanted = (0.6, 0.0, 0.8)
    push, d = solve(2, (0.0, 0.0, 1.0), slanted, slanted, 1.0, 0.5, 0.0)
    assert push == (1.0, 0.0, 0.0) and d == (0.0, 0.0, 1.0)


def test_parallel_and_opposite_normals_give_finite_weights():
    """Two walls with one normal, and a gap too narrow, are solved without a division by nothing."""
    up, down = (0.0, 0.0, 1.0), (0.0, 0.0, -1.0)
    assert solve(2, up, up, up, 1.0, 1.0, 0.0)[1] == (0.0, 0.0, 1.0)
    assert solve(2, up, down, up, 1.0, 0.5, 0.0)[1] == (0.0, 0.0, 1.0)
    assert np.isfinite(solve(3, up, down, (1.0, 0.0, 0.0), 1.0, 1.0, 1.0)[1]).all()
