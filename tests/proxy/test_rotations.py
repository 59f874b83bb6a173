"""Rotation kernels compared with extended precision, on both sides of every switch of formulas."""

import numpy as np
import pytest
from references.rotation import matrix

from softfinger.proxy.kernels.numerics import rotations

ULP = np.finfo(np.float64).eps
SEAM = rotations.SERIES_MAX
ARGUMENTS = np.unique(
    np.concatenate([np.geomspace(1e-300, 3.0, 400), np.linspace(0.9 * SEAM, 1.1 * SEAM, 401), [np.nextafter(SEAM, 0)]])
)

pytestmark = [
    pytest.mark.plain,
    pytest.mark.skipif(
        np.finfo(np.longdouble).eps >= ULP, reason="this machine has no float wider than float64 to compare with"
    ),
]


def test_sinc_is_exact_to_rounding():
    for x in ARGUMENTS.tolist():
        wide = np.longdouble(x)
        expected = float(np.sin(wide) / wide)
        # The series rounds once per term, and every term but the first is below 1/600 of it.
        assert abs(rotations.sinc_of_root(x * x) - expected) <= 2.0 * ULP * abs(expected)
    assert rotations.sinc_of_root(0.0) == 1.0


def test_angle_of_is_exact_to_rounding():
    for ratio in ARGUMENTS.tolist():
        for c in (1.0, 0.7, 1e-3):
            s = ratio * c
            if s == 0.0:
                continue
            expected = float(2 * np.arctan2(np.longdouble(s), np.longdouble(c)))
            # One rounding of the quotient and a few of the series; the library's call is within one.
            assert abs(rotations.angle_of(s, c) - expected) <= 3.0 * ULP * expected
            assert rotations.angle_of(-s, c) == -rotations.angle_of(s, c)
    assert rotations.angle_of(0.0, 1.0) == 0.0 and rotations.angle_of(0.0, 0.0) == 0.0
    assert rotations.angle_of(1.0, 0.0) == np.pi


def test_roll_of_a_unit_ball_is_exact_to_rounding():
    """A tilt by theta about e, after a spin about n, moves a unit ball by theta h x n, with the heading h half-way."""
    rng = np.random.default_rng(4)
    for theta in ARGUMENTS[ARGUMENTS < 3.0].tolist():
        n = rng.normal(size=3)
        n /= np.linalg.norm(n)
        e = np.cross(n, rng.normal(size=3))
        e /= np.linalg.norm(e)
        spin = rng.uniform(-0.3, 0.3)
        tilt = (np.cos(0.5 * theta), *(np.sin(0.5 * theta) * e))
        turn = rotations.multiply(tilt, (np.cos(0.5 * spin), *(np.sin(0.5 * spin) * n)))
        heading = np.cos(0.5 * spin) * e + np.sin(0.5 * spin) * np.cross(e, n)
        # Roundings of sums of terms as large as the angles, and of n and e, which are unit vectors to rounding.
        tolerance = 4.0 * ULP * (theta + abs(spin))
        path = rotations.roll_unit_ball(turn, tuple(n))
        np.testing.assert_allclose(path, theta * np.cross(heading, n), rtol=0, atol=tolerance)
    assert rotations.roll_unit_ball((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 1.0)) == (0.0, 0.0, 0.0)


def test_exp_and_log_are_inverse():
    rng = np.random.default_rng(5)
    for length in np.geomspace(1e-150, 3.0, 200).tolist():
        axis = rng.normal(size=3)
        vector = length * axis / np.linalg.norm(axis)
        back = rotations.log(rotations.exp(tuple(vector)))
        # Near half a turn the cosine is insensitive and the sine loses digits: a few roundings in all.
        np.testing.assert_allclose(back, vector, rtol=0, atol=8.0 * ULP * length)


def test_quaternion_of_a_matrix_is_exact_to_rounding():
    rng = np.random.default_rng(6)
    axes = [*np.eye(3), *(-np.eye(3)), *rng.normal(size=(20, 3))]
    quaternions = [*rng.normal(size=(500, 4)), [1.0, 0.0, 0.0, 0.0]]
    for axis in axes:
        unit = axis / np.linalg.norm(axis)
        quaternions.extend([w, *unit] for w in (0.0, 1e-17, 1e-9, -1e-9, 1e-3))
    for q in quaternions:
        q = np.array(q) / np.linalg.norm(q)
        back = rotations.from_matrix(tuple(map(tuple, matrix(q).tolist())))
        assert back[0] >= 0.0 and sum(part * part for part in back) == pytest.approx(1.0, abs=4 * ULP)
        # Equal up to the sign; the matrix's rounding is a few units of the last place, and no component is lost.
        assert min(np.abs(back - q).max(), np.abs(back + q).max()) < 8 * ULP


def test_unit_quaternions_are_not_renormalised():
    """A normalised quaternion that is recorded and read again has the same bits."""
    random = np.random.default_rng(5)
    for q in (random.standard_normal((20000, 4)) * random.uniform(0.5, 1.5, (20000, 1))).tolist():
        once = rotations.normalize(tuple(q))
        assert rotations.as_unit(once) == once
        wide = np.array(q, np.longdouble)
        exact = (wide / np.sqrt(wide @ wide)).astype(float)
        assert np.abs(np.array(once) - exact).max() <= 2.5 * ULP  # five roundings of half a unit each
        near = tuple(x * (1.0 + 16.0 * ULP) for x in once)
        assert abs(sum(x * x for x in rotations.as_unit(near)) - 1.0) < rotations.UNIT_TO_ROUNDING
