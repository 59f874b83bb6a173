"""Checks of poses from Python."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import HapticError
from softfinger.proxy.record import POSITION_MAX_M

Array = NDArray[np.float64]


class PoseError(HapticError):
    """Pose or time step that is not possible for a probe."""


def stack_poses(poses: Mapping[str, Any], fingers: Sequence[str]) -> Array:
    """Stack the poses (n, 7) of each finger, given by name, to (n, fingers, 7).

    Raises PoseError if a pose cannot be used, or the names or lengths do not match.
    """
    if set(poses) != set(fingers):
        names = ", ".join(fingers) or "one, with poses without a name"
        raise PoseError(f"poses of {', '.join(map(str, poses))} do not match the fingers of the scene: {names}")
    checked = [check_poses(_to_array(poses[name])) for name in fingers]
    if len({len(rows) for rows in checked}) > 1:
        counts = ", ".join(f"{len(rows)} of {name}" for name, rows in zip(fingers, checked, strict=True))
        raise PoseError(f"all fingers need the same number of poses, not {counts}")
    return np.ascontiguousarray(np.stack(checked, axis=1))


def _to_array(poses: Any) -> Array:
    try:
        return np.asarray(poses, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise PoseError(f"poses are no array of numbers (n, 7), rows x, y, z, qw, qx, qy, qz: {error}") from None


def check_poses(poses: Array) -> Array:
    """Return poses (n, 7) as a contiguous array; raise PoseError for the first row that cannot be used."""
    if poses.ndim != 2 or poses.shape[1] != 7:
        raise PoseError(f"poses of shape {poses.shape}: expected (n, 7), rows x, y, z, qw, qx, qy, qz")
    norms = np.linalg.norm(poses[:, 3:], axis=1)
    for usable, why in (
        (np.isfinite(poses).all(axis=1), "every number must be finite"),
        ((np.abs(poses[:, :3]) <= POSITION_MAX_M).all(axis=1), f"coordinates must be at most {POSITION_MAX_M:g} m"),
        ((norms >= 1e-6) & (norms <= 1e6), "the last four are a quaternion, whose norm must be from 1e-6 to 1e6"),
    ):
        if not usable.all():
            row = int(usable.argmin())
            raise PoseError(f"pose {row} is {poses[row].tolist()}: {why}")
    return np.ascontiguousarray(poses)
