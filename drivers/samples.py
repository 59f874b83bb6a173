"""Parts of samples and wrenches that the exchanges of several drivers share, in nopython mode.

After a pause of the loop (compiling, stopped in a debugger, starved by other processes), it finds old answers, or
answers to old requests. The drivers discard them and wait for a current one; briefly if there is a sample to repeat.
The pause does not count as silence of the device, because nothing was read in it. Its last sample is old, however, so
the drivers send no force until there is a new one.
"""

from __future__ import annotations

from math import isfinite, nan
from typing import Any, Final

from softfinger.drivers.base import SAMPLE_SIZE
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Quaternion, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.rotations import from_matrix

ROTATION_TOLERANCE: Final = 0.01
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
    is_rotation = abs(vec3.dot(rows[0], vec3.cross(rows[1], rows[2])) - 1.0) < ROTATION_TOLERANCE
    for i in range(3):
        is_rotation = is_rotation and abs(vec3.norm(rows[i]) - 1.0) < ROTATION_TOLERANCE
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


PAUSE_MIN_NS: Final = 30_000_000
"""Shortest time between two reads that counts as a pause of the loop: three periods of the slowest one.

A hand moves by millimetres in it.
"""
CURRENT_WAIT_MAX_NS: Final = 100_000_000
"""Longest wait of a running loop for a current answer: the supervisor ends a loop that stalls for 0.25 s."""


@jit
def shift_sample_time(sampled_at: int, read_at: int, now: int, quiet: int) -> int:
    """Return the time (ns) to use as that of the last answer after a pause of the loop.

    sampled_at  ns  time of the last answer
    read_at     ns  time of the last read
    quiet       ns  silence after which no force is sent
    """
    return min(sampled_at + now - read_at, now - quiet - 1)
