"""Recorded poses at the servo's rate: interpolated with continuous velocity, and closed into a loop without a jump."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config.arrays import Array
from softfinger.config.errors import RecordingError
from softfinger.drivers import quaternions
from softfinger.drivers.poses import Poses

SAMPLES_MAX: Final = 10_000_000  # 2.8 h at 1 kHz, 560 MB
BLOCK: Final = 16384  # ticks interpolated at a time: the intermediate arrays need five times the memory
SAME_TIME_S: Final = 1e-9  # a tick this close to a recorded sample uses that sample unchanged
RETURN_SPEED_M_PER_S: Final = 0.1
RETURN_SPEED_RAD_PER_S: Final = 1.0
RETURN_MIN_S: Final = 0.5
MINIMUM_JERK_PEAK: Final = 1.875  # ratio of peak to mean speed of a minimum-jerk movement
SEAM_TOLERANCE: Final = 1e-9  # m and rad: end and start closer than this are the same pose
SEAM_SPEED_M_PER_S: Final = 1e-3  # a smaller velocity step at the seam needs no return
SEAM_SPEED_RAD_PER_S: Final = 1e-2


def resample(poses: Poses, rate_hz: float) -> Array:
    """Return poses (M, 7) at ticks k / rate_hz from the first sample to the last: x, y, z, qw, qx, qy, qz.

    Positions use shape-preserving cubic Hermite interpolation: through every sample, without overshoot and with
    continuous velocity, so that a 100 Hz recording has no velocity steps at 1 kHz. Orientations turn at a constant rate
    by the shorter rotation (slerp). Raises RecordingError if the recording is shorter than two ticks or too long for
    the memory.
    """
    duration = float(poses.t[-1]) - float(poses.t[0])
    ticks = duration * rate_hz + 1e-6
    if not 1.0 <= ticks < SAMPLES_MAX:
        raise RecordingError(
            f"recording of {duration:g} s is {ticks:.4g} ticks at {rate_hz:g} Hz, must be 1 to {SAMPLES_MAX:,}: "
            "choose another rate or cut the recording"
        )
    t = poses.t - poses.t[0]
    at = np.arange(int(ticks) + 1) / rate_hz
    near = np.searchsorted(t, at - SAME_TIME_S)
    on_sample = (near < len(t)) & (np.abs(t[np.minimum(near, len(t) - 1)] - at) <= SAME_TIME_S)
    if on_sample.all():  # recorded at this rate
        return np.concatenate((poses.position[near], poses.orientation[near]), axis=1)
    samples, slopes = np.empty((len(at), 7)), _compute_slopes(t, poses.position)
    for first in range(0, len(at), BLOCK):
        chunk = slice(first, first + BLOCK)
        segment = np.clip(np.searchsorted(t, at[chunk], side="right") - 1, 0, len(t) - 2)
        width = t[segment + 1] - t[segment]
        u = np.clip((at[chunk] - t[segment]) / width, 0.0, 1.0)[:, None]
        samples[chunk, :3] = _interpolate_hermite(poses.position, slopes, segment, width[:, None], u)
        samples[chunk, 3:] = slerp(poses.orientation[segment], poses.orientation[segment + 1], u)
    samples[on_sample, :3] = poses.position[near[on_sample]]
    samples[on_sample, 3:] = poses.orientation[near[on_sample]]
    return samples


def _compute_slopes(t: Array, x: Array) -> Array:
    """Return velocities (N, 3) at the samples that make the interpolant monotone wherever the samples are.

    Source: Fritsch, Carlson (1980), with the weighted harmonic mean of Fritsch, Butland (1984) and their one-sided
    three-point rule at both ends.
    """
    h = np.diff(t)[:, None]
    secant = np.diff(x, axis=0) / h
    if len(t) == 2:
        return np.repeat(secant, 2, axis=0)
    slope = np.zeros_like(x)
    left, right = secant[:-1], secant[1:]
    w_left, w_right = 2.0 * h[1:] + h[:-1], h[1:] + 2.0 * h[:-1]
    monotone = (np.sign(left) * np.sign(right)) > 0.0
    safe_left, safe_right = np.where(monotone, left, 1.0), np.where(monotone, right, 1.0)
    with np.errstate(over="ignore"):  # a secant near zero gives slope 0, as it should
        mean = (w_left + w_right) / (w_left / safe_left + w_right / safe_right)
    slope[1:-1] = np.where(monotone, mean, 0.0)
    slope[0] = _end_slope(h[0], h[1], secant[0], secant[1])
    slope[-1] = _end_slope(h[-1], h[-2], secant[-1], secant[-2])
    return slope


def _end_slope(h0: Array, h1: Array, secant0: Array, secant1: Array) -> Array:
    slope: Array = ((2.0 * h0 + h1) * secant0 - h0 * secant1) / (h0 + h1)
    slope = np.where(np.sign(slope) != np.sign(secant0), 0.0, slope)
    turns = np.sign(secant0) != np.sign(secant1)
    return np.where(turns & (np.abs(slope) > 3.0 * np.abs(secant0)), 3.0 * secant0, slope)


def _interpolate_hermite(x: Array, slope: Array, segment: NDArray[np.intp], width: Array, u: Array) -> Array:
    a, b = x[segment], x[segment + 1]
    rise = u * u * (3.0 - 2.0 * u)
    value: Array = a + rise * (b - a) + width * u * (1.0 - u) * ((1.0 - u) * slope[segment] - u * slope[segment + 1])
    return value


def slerp(a: Array, b: Array, u: Array) -> Array:
    """Return unit quaternions (M, 4) at a fraction u (M, 1) of the shorter rotation from a to b."""
    b = np.where(np.sum(a * b, axis=1, keepdims=True) < 0.0, -b, b)
    # atan2 of chord lengths is accurate at small angles, unlike acos of the dot product
    half = np.arctan2(np.linalg.norm(b - a, axis=1), np.linalg.norm(b + a, axis=1))[:, None]
    sine = np.sin(2.0 * half)
    small = sine < 1e-9
    safe = np.where(small, 1.0, sine)
    mixed = (
        np.where(small, 1.0 - u, np.sin((1.0 - u) * 2.0 * half) / safe) * a
        + np.where(small, u, np.sin(u * 2.0 * half) / safe) * b
    )
    unit: Array = mixed / np.linalg.norm(mixed, axis=1, keepdims=True)
    return unit


def close_loop(samples: Array, rate_hz: float) -> Array:
    """Return one period (L, 7) of the endless motion that repeats `samples` (M, 7) without a jump.

    If the end does not continue into the start, a return is appended. It starts with the velocity of the end and
    finishes with the velocity of the start, in position and orientation; it is no faster than 0.1 m/s and 1 rad/s on
    top of those velocities. If end and start are the same pose with the same velocity, the repeated sample is dropped
    instead. Sample L of the motion is sample 0.
    """
    end, start = samples[-1], samples[0]
    travel, rotation_vector = start[:3] - end[:3], quaternions.log(_rotate_relative(end[3:], start[3:]))
    distance, angle = float(np.linalg.norm(travel)), float(np.linalg.norm(rotation_vector))
    if distance <= SEAM_TOLERANCE and angle <= SEAM_TOLERANCE and _is_continuous(samples, rate_hz):
        return np.ascontiguousarray(samples[:-1])

    start_velocity, end_velocity = (samples[-1, :3] - samples[-2, :3]) * rate_hz, (samples[1, :3] - start[:3]) * rate_hz
    start_spin = quaternions.log(_rotate_relative(samples[-2, 3:], end[3:])) * rate_hz
    end_spin = quaternions.log(_rotate_relative(start[3:], samples[1, 3:])) * rate_hz
    seconds = max(
        RETURN_MIN_S,
        MINIMUM_JERK_PEAK * distance / RETURN_SPEED_M_PER_S,
        MINIMUM_JERK_PEAK * angle / RETURN_SPEED_RAD_PER_S,
    )
    count = max(2, int(np.ceil(seconds * rate_hz)))
    u = (np.arange(1, count) / count)[:, None]
    seconds = count / rate_hz
    path = np.empty((count - 1, 7))
    path[:, :3] = end[:3] + _interpolate_quintic(travel, start_velocity, end_velocity, seconds, u)
    # Turn in the body frame at the end: there the rate of the rotation vector is the angular velocity. At the start it
    # is so only through the inverse Jacobian of the rotation vector.
    rotation = _interpolate_quintic(
        rotation_vector, start_spin, _compute_inverse_jacobian(rotation_vector) @ end_spin, seconds, u
    )
    path[:, 3:] = quaternions.multiply(end[3:], quaternions.exp(rotation))
    return np.concatenate((samples, path))


def _is_continuous(samples: Array, rate_hz: float) -> bool:
    """Return True if the velocity step from the end to the start is no larger than the steps within the motion."""
    velocity = np.diff(samples[:, :3], axis=0) * rate_hz
    spin = quaternions.log(_rotate_relative(samples[:-1, 3:], samples[1:, 3:])) * rate_hz
    for rates, negligible in ((velocity, SEAM_SPEED_M_PER_S), (spin, SEAM_SPEED_RAD_PER_S)):
        within = np.linalg.norm(np.diff(rates, axis=0), axis=1)
        if np.linalg.norm(rates[0] - rates[-1]) > max(negligible, float(within.max(initial=0.0))):
            return False
    return True


def _interpolate_quintic(travel: Array, start_velocity: Array, end_velocity: Array, seconds: float, u: Array) -> Array:
    """Return the minimum-jerk path from 0 to `travel` with the given velocities and zero acceleration at both ends."""
    rise = u**3 * (10.0 - 15.0 * u + 6.0 * u**2)
    out = u - u**3 * (6.0 - 8.0 * u + 3.0 * u**2)
    into = -(u**3) * (4.0 - 7.0 * u + 3.0 * u**2)
    path: Array = rise * travel + seconds * (out * start_velocity + into * end_velocity)
    return path


def _rotate_relative(a: Array, b: Array) -> Array:
    """Return a^-1 b: the rotation from a to b in the body frame."""
    return quaternions.multiply(quaternions.conjugate(a), b)


def _compute_inverse_jacobian(rotation: Array) -> Array:
    """Return the (3, 3) inverse right Jacobian, from body angular velocity to the rate of the rotation vector."""
    angle = float(np.linalg.norm(rotation))
    x, y, z = rotation
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    factor = 1.0 / 12.0 if angle < 1e-4 else 1.0 / angle**2 - 0.5 / (angle * np.tan(0.5 * angle))
    inverse: Array = np.eye(3) + 0.5 * cross + factor * cross @ cross
    return inverse
