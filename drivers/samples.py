"""Parts of samples and wrenches that the exchanges of several drivers share, in nopython mode."""

from __future__ import annotations

from math import isfinite, nan
from typing import Any, Final

from softfinger.drivers.base import SAMPLE_SIZE
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Quaternion, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.rotations import from_matrix

NOT_A_ROTATION: Final = 0.01
"""Tolerance of the rows' lengths and of the determinant; a larger deviation from 1 is a fault, not a rotation.

Rows of length 1 that span a volume of 1 are orthogonal.
"""


@jit
def copy_sample(source: Any, target: Any) -> None:
    for k in range(SAMPLE_SIZE):
        target[k] = source[k]


@jit
def store_pose(sample: Any, position: Vec3, orientation: Quaternion) -> None:
    sample[0], sample[1], sample[2] = position
    sample[3], sample[4], sample[5], sample[6] = orientation


@jit
def convert_matrix(rows: tuple[Vec3, Vec3, Vec3]) -> Quaternion:
    """Return the orientation of a matrix (3, 3); NaN if it is not a rotation."""
    is_rotation = abs(vec3.dot(rows[0], vec3.cross(rows[1], rows[2])) - 1.0) < NOT_A_ROTATION
    for i in range(3):
        is_rotation = is_rotation and abs(vec3.norm(rows[i]) - 1.0) < NOT_A_ROTATION
    return from_matrix(rows) if is_rotation else (nan, nan, nan, nan)


@jit
def is_zero(wrench: Any, count: int) -> bool:
    """Return True if the first `count` components of a wrench are 0: 3 without torque, 6 with it."""
    zero = True
    for k in range(count):
        zero = zero and wrench[k] == 0.0
    return zero


@jit
def is_finite(wrench: Any, count: int) -> bool:
    """Return True if the first `count` components of a wrench are finite."""
    finite = True
    for k in range(count):
        finite = finite and isfinite(wrench[k])
    return finite
