"""Arithmetic of unit quaternions w, x, y, z in NumPy, for arrays of any leading shape. Kernels use `rotations`."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from softfinger.config.arrays import Array


def multiply(a: ArrayLike, b: ArrayLike) -> Array:
    """Return the rotation (..., 4) by `b` followed by `a`."""
    aw, ax, ay, az = np.moveaxis(np.asarray(a, np.float64), -1, 0)
    bw, bx, by, bz = np.moveaxis(np.asarray(b, np.float64), -1, 0)
    return np.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        axis=-1,
    )


def conjugate(q: ArrayLike) -> Array:
    """Return the inverse rotation (..., 4)."""
    w, x, y, z = np.moveaxis(np.asarray(q, np.float64), -1, 0)
    return np.stack((w, -x, -y, -z), axis=-1)


def log(q: Array) -> Array:
    """Return rotation vectors (..., 3) rad, at most half a turn."""
    vector = np.where(q[..., :1] >= 0.0, q[..., 1:], -q[..., 1:])
    sine = np.linalg.norm(vector, axis=-1, keepdims=True)
    small = sine < 1e-12
    angle = 2.0 * np.arctan2(sine, np.abs(q[..., :1]))
    rotation: Array = np.where(small, 2.0, angle / np.where(small, 1.0, sine)) * vector
    return rotation


def exp(rotation: ArrayLike) -> Array:
    """Return the quaternions (..., 4) of rotation vectors (..., 3) rad."""
    vector = np.asarray(rotation, np.float64)
    half = 0.5 * np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.concatenate((np.cos(half), 0.5 * vector * np.sinc(half / np.pi)), axis=-1)
