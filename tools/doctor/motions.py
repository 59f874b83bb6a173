"""Evaluation of a report's rows: noise at rest, axis and sense of a motion, and response to a push."""

from __future__ import annotations

from math import atan2, degrees
from typing import Any, Final

import numpy as np

from softfinger.drivers import quaternions
from softfinger.drivers.base import SAMPLE_BUTTONS
from softfinger.tools.exchange import FORCE, SAMPLE
from softfinger.tools.measure import Array

AXES: Final = "xyz"

MIN_MOVE_M: Final = 0.005
"""Smallest displacement that counts as a motion; requested motions are some centimetres."""
MIN_TURN_RAD: Final = 0.1
CLEAR_RATIO: Final = 2.0
"""A motion is along an axis if that component is this many times the next largest."""
REST_PERCENTILES: Final = (5.0, 95.0)
"""Percentiles between which the position at rest counts as motion by itself; they exclude initial settling."""
END_SHARE: Final = 0.1
"""Fraction of a part at either end; the median over it is the start or end position."""

SHARE_MIN: Final = 0.5
"""Fraction of the variance of the motion that a push must explain to be its cause."""
MIN_RESPONSE_M: Final = 2e-5
"""A response smaller than the steps of common encoders counts as none."""
SPRING_LAG_DEG: Final = 15.0
"""Lags closer than this to 0 belong to a handle in a springy hand.

Lags closer than this to half a cycle belong to a free mass or to a force of the wrong sign, which are not
distinguished.
"""


def select_finite(rows: Array) -> Array:
    return rows[np.isfinite(rows[:, SAMPLE : SAMPLE + 7]).all(axis=1)]


def measure_rest(rows: Array, turns: bool) -> dict[str, Any] | None:
    """Return mean position and standard deviation per axis, m, and of the rotation about each world axis, rad.

    Returns None without rows.
    """
    valid = select_finite(rows)
    if len(valid) < 2:
        return None
    place = valid[:, SAMPLE : SAMPLE + 3]
    about = np.array([compute_rotation(valid[0], row) for row in valid]) if turns else None
    return {
        "ticks": len(valid),
        "not_finite": len(rows) - len(valid),
        "position_m": place.mean(axis=0).tolist(),
        "position_std_m": place.std(axis=0).tolist(),
        "rotation_std_rad": about.std(axis=0).tolist() if about is not None else None,
    }


def measure_drift(rows: Array) -> Array:
    """Return the deviation (3,) m of the handle from its middle along each axis while nothing pushed it."""
    valid = select_finite(rows)[:, SAMPLE : SAMPLE + 3]
    if len(valid) == 0:
        return np.zeros(3)
    low, high = np.percentile(valid, REST_PERCENTILES, axis=0)
    return np.asarray(0.5 * (high - low))


def measure_range(rows: Array) -> dict[str, list[float]] | None:
    """Return the range of the handle: smallest and largest coordinates, m."""
    valid = select_finite(rows)[:, SAMPLE : SAMPLE + 3]
    if len(valid) == 0:
        return None
    return {"position_min_m": valid.min(axis=0).tolist(), "position_max_m": valid.max(axis=0).tolist()}


def list_masks(rows: Array) -> list[int]:
    return sorted({int(value) for value in rows[:, SAMPLE + SAMPLE_BUTTONS] if np.isfinite(value)})


def compute_rotation(before: Array, after: Array) -> Array:
    """Return the shorter rotation vector (3,) rad, world frame, from the orientation of one row to that of another."""
    before, after = before[SAMPLE + 3 : SAMPLE + 7], after[SAMPLE + 3 : SAMPLE + 7]
    return quaternions.log(quaternions.multiply(after, quaternions.conjugate(before)))


def compute_translation(rows: Array) -> Array:
    """Return the displacement (3,) m of the handle from the start of a part to its end."""
    valid = select_finite(rows)
    count = max(1, round(END_SHARE * len(valid)))
    displacement: Array = np.median(valid[-count:, SAMPLE : SAMPLE + 3], axis=0) - np.median(
        valid[:count, SAMPLE : SAMPLE + 3], axis=0
    )
    return displacement


def measure_motion(request: str, kind: str, expected: str, rows: Array) -> dict[str, Any] | None:
    """Return the result of a requested motion. `kind`: translation or rotation; `expected`: an axis, as '+x'."""
    valid = select_finite(rows)
    if len(valid) == 0:
        return None
    turned = kind == "rotation"
    vector = compute_rotation(valid[0], valid[-1]) if turned else compute_translation(valid)
    direction = name_axis(vector, MIN_TURN_RAD if turned else MIN_MOVE_M)
    return {
        "asked": request,
        "kind": kind,
        "expected": expected,
        "seen": direction,
        "agrees": direction == expected,
        "vector": vector.tolist(),
        "unit": "rad" if turned else "m",
    }


def name_axis(vector: Array, least: float) -> str:
    """Return the axis and sense of a vector (3,), as '+x', or a text if there is none."""
    sizes = np.abs(vector)
    if sizes.max() < least:
        return "no motion"
    order = np.argsort(sizes)
    if sizes[order[2]] < CLEAR_RATIO * sizes[order[1]]:
        return "not along one axis"
    largest = int(order[2])
    return f"{'+' if vector[largest] > 0.0 else '-'}{AXES[largest]}"


def measure_response(
    axis: int, frequency_hz: float, rate_hz: float, rows: Array, drift_m: Array | None = None
) -> dict[str, Any] | None:
    """Return the response to a push along an axis, from the motion that is correlated with the written force.

    The motion is fitted by the force, the force a quarter of a cycle later, and a slow drift. The lag is the fraction
    of a cycle by which the motion follows the force: 0 for a handle on a spring, a quarter for a damped one, half a
    cycle for a free mass. Any passive load is within this range; a force of the wrong sign is outside.

    rows     (n, ROW_SIZE) of the push; the result is None if they have no pose or no force
    drift_m  (3,) m, motion of the handle without a push (`measure_drift`); a response that is not larger cannot be
             attributed to the push
    """
    is_valid = np.isfinite(rows[:, SAMPLE : SAMPLE + 3]).all(axis=1)
    force, place = rows[:, FORCE + axis], rows[:, SAMPLE : SAMPLE + 3]
    if is_valid.sum() < 8 or not force.any():
        return None
    late = 2.0 * np.pi * frequency_hz / rate_hz * np.cumsum(force)
    t = np.linspace(-1.0, 1.0, len(rows))
    drift = np.stack([np.ones_like(t), t, t * t], axis=1)[is_valid]
    basis, motion = (_remove_drift(drift, part[is_valid]) for part in (np.stack([force, late], axis=1), place))
    solution, *_ = np.linalg.lstsq(basis, motion, rcond=None)
    fitted = basis @ solution
    k = int(np.argmax((fitted**2).sum(axis=0)))
    share = float((fitted[:, k] ** 2).sum() / max((motion[:, k] ** 2).sum(), 1e-300))
    compliance = float(np.hypot(*solution[:, k]))
    lag = degrees(atan2(solution[1, k], solution[0, k]))
    largest = float(np.abs(force).max())
    return {
        "axis": f"+{AXES[axis]}",
        "largest_n": largest,
        "frequency_hz": frequency_hz,
        "moved_axis": AXES[k],
        "m_per_n": compliance,
        "lag_deg": lag,
        "share": share,
        "seen": _judge(AXES[k], compliance * largest, lag, share, 0.0 if drift_m is None else float(drift_m[k])),
    }


def _remove_drift(drift: Array, values: Array) -> Array:
    """Return `values` (n, k) without the part that `drift` (n, m) explains."""
    fit, *_ = np.linalg.lstsq(drift, values, rcond=None)
    remainder: Array = values - drift @ fit
    return remainder


def _judge(axis: str, size_m: float, lag_deg: float, share: float, drift_m: float) -> str:
    if size_m < MIN_RESPONSE_M:
        return "no motion"
    if size_m < drift_m:
        return f"unclear: at rest the handle moved along {axis} by as much"
    if share < SHARE_MIN:
        return f"not clear: the push accounts for {share:.0%} of the motion"
    if abs(lag_deg) > 180.0 - SPRING_LAG_DEG:
        return f"moves along {axis}; a free handle, or the wrong sign: hold it lightly and push again"
    return f"{'-' if lag_deg < -SPRING_LAG_DEG else '+'}{axis}"
