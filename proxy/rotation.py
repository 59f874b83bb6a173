"""Rotation matrix of a quaternion, in Python: compiling a kernel would delay the start."""

from __future__ import annotations

from softfinger.proxy.kernels.model import Quaternion, Vec3


def make_matrix(q: Quaternion) -> tuple[Vec3, Vec3, Vec3]:
    """Return the rows (3, 3) of the rotation matrix of the unit quaternion `q` (w, x, y, z)."""
    w, x, y, z = q
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )
