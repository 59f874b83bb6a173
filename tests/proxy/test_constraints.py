"""Solver of multiple contacts, compared with non-negative least squares."""

import numpy as np
import pytest
from scipy.optimize import nnls

from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.half_spaces import FACING_COSINE, solve_half_spaces

pytestmark = pytest.mark.plain


@entry
def solve(count, n1, n2, n3, b1, b2, b3):
    solution = solve_half_spaces(count, n1, n2, n3, b1, b2, b3)
    return solution.push, vec3.weighted_sum(solution.place, n1, n2, n3)


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
