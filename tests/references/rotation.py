"""Rotations in plain numpy, by the textbook formulas: nothing here is shared with the kernels."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def rodrigues(w: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of the rotation vector w (3,) rad: the paper's eq. 4 with its signs restored."""
    w = np.asarray(w, float)
    angle = float(np.linalg.norm(w))
    if angle == 0.0:
        return np.eye(3)
    a = w / angle
    s = np.array([[0.0, -a[2], a[1]], [a[2], 0.0, -a[0]], [-a[1], a[0], 0.0]])
    return np.asarray(np.outer(a, a) + (np.eye(3) - np.outer(a, a)) * math.cos(angle) + s * math.sin(angle))


def quaternion(w: ArrayLike) -> Array:
    """Quaternions (..., 4) w, x, y, z of rotation vectors w (..., 3) rad."""
    w = np.asarray(w, float)
    angle = np.linalg.norm(w, axis=-1, keepdims=True)
    return np.concatenate([np.cos(angle / 2), 0.5 * np.sinc(angle / (2 * math.pi)) * w], axis=-1)


def multiply(a: ArrayLike, b: ArrayLike) -> Array:
    """Quaternion products a b (..., 4): rotate by b, then by a."""
    a, b = np.asarray(a, float), np.asarray(b, float)
    scalar = a[..., :1] * b[..., :1] - np.sum(a[..., 1:] * b[..., 1:], axis=-1, keepdims=True)
    vector = a[..., :1] * b[..., 1:] + b[..., :1] * a[..., 1:] + np.cross(a[..., 1:], b[..., 1:])
    return np.concatenate([scalar, vector], axis=-1)


def matrix(q: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of the quaternion q (4,), which need not be unit."""
    w, x, y, z = np.asarray(q, float) / np.linalg.norm(q)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def tangent_frame(normal: ArrayLike) -> Array:
    """A right-handed frame (3, 3), columns x, y tangent and z = normal, to world."""
    n = np.asarray(normal, float)
    n = n / np.linalg.norm(n)
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(n)))], n)
    x = x / np.linalg.norm(x)
    return np.column_stack([x, np.cross(n, x), n])
