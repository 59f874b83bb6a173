"""Classical method: Montana's equations, integrated between two poses as by Matlab's ODE45.

The paper compares its algorithm with this method. From the contact coordinates and the rotation of a step it integrates
u_f, v_f, u_o, v_o and psi with the Dormand-Prince pair: order 5, error estimate of order 4, last stage equal to the
first of the next step. The defaults of ODE45 are a relative tolerance of 1e-3, an absolute tolerance of 1e-6, steps of
at most a tenth of the span, and a first step chosen from the slope at the start.
"""

from __future__ import annotations

from math import cos, sin
from typing import Any, Final, NamedTuple

from softfinger.proxy.kernels.jit.decorators import entry, jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.server.loop.clock import Stopwatch, read_clock_ns
from softfinger.tools.accuracy.montana import Coordinates, advance, compute_chart, compute_rolling_rates
from softfinger.tools.measure import Array

RELATIVE_TOLERANCE: Final = 1e-3
ABSOLUTE_TOLERANCE: Final = 1e-6
MAX_STEP_SHARE: Final = 0.1
"""Longest step, as a fraction of the span."""
THRESHOLD: Final = ABSOLUTE_TOLERANCE / RELATIVE_TOLERANCE
"""Coordinates smaller than this are compared with the absolute tolerance."""


class Precession(NamedTuple):
    """Angular velocity with a rotating axis: `w` (3,) rad/s, turned about `normal` by angle + spin_rate t, rad."""

    w: Vec3
    normal: Vec3
    angle: float
    spin_rate: float


class Steps(NamedTuple):
    """Rotations, each at a constant rate during its step.

    turns      (n, 4)  unit quaternions, world frame
    dt         s       length of a step
    spin_rate  rad/s   rate at which the rotation axes spin about the normal at the start; 0 for axes of the world
    """

    turns: Array
    dt: float
    spin_rate: float


@jit
def compute_slope(radius: float, shape: Any, at: Coordinates, w: Vec3, normal: Vec3, angle: float) -> Coordinates:
    """Return the rates of the coordinates at the angular velocity `w` (3,) rad/s, turned by `angle` about `normal`."""
    if angle != 0.0:
        c, s = cos(angle), sin(angle)
        along = vec3.scale((1.0 - c) * vec3.dot(w, normal), normal)
        w = vec3.add(vec3.add_scaled(vec3.scale(c, w), s, vec3.cross(normal, w)), along)
    return compute_rolling_rates(radius, shape, at, w)


@jit
def compute_weight(y: float, y_ahead: float) -> float:
    return 1.0 / max(abs(y), abs(y_ahead), THRESHOLD)


@jit
def find_largest(v: Coordinates, y: Coordinates, y_ahead: Coordinates) -> float:
    """Return the largest component of v, each relative to the larger of y and y_ahead, or to the threshold."""
    first = max(abs(v.u_f) * compute_weight(y.u_f, y_ahead.u_f), abs(v.v_f) * compute_weight(y.v_f, y_ahead.v_f))
    second = max(abs(v.u_o) * compute_weight(y.u_o, y_ahead.u_o), abs(v.v_o) * compute_weight(y.v_o, y_ahead.v_o))
    return max(first, second, abs(v.psi) * compute_weight(y.psi, y_ahead.psi))


@jit
def solve_ode45(
    radius: float, shape: Any, start: Coordinates, precession: Precession, span: float, share: float
) -> tuple[Coordinates, int]:
    """Return the coordinates after `span` (s), and the number of evaluations of the equations.

    share  longest step, as a fraction of the span
    """
    w, normal, angle, spin_rate = precession
    y, t, count = start, 0.0, 1
    k1 = compute_slope(radius, shape, y, w, normal, angle)
    h = share * span
    rate_ratio = find_largest(k1, y, y) / (0.8 * RELATIVE_TOLERANCE**0.2)
    if h * rate_ratio > 1.0:
        h = 1.0 / rate_ratio
    failed, is_done = False, False
    while not is_done:
        h = min(h, share * span)
        last = 1.1 * h >= span - t
        if last:
            h = span - t
        start_angle = angle + spin_rate * t
        turn = spin_rate * h
        k2 = compute_slope(radius, shape, advance(y, h / 5, k1), w, normal, start_angle + turn / 5)
        ahead = advance(advance(y, h * 3 / 40, k1), h * 9 / 40, k2)
        k3 = compute_slope(radius, shape, ahead, w, normal, start_angle + turn * 3 / 10)
        ahead = advance(advance(advance(y, h * 44 / 45, k1), h * -56 / 15, k2), h * 32 / 9, k3)
        k4 = compute_slope(radius, shape, ahead, w, normal, start_angle + turn * 4 / 5)
        ahead = advance(advance(y, h * 19372 / 6561, k1), h * -25360 / 2187, k2)
        ahead = advance(advance(ahead, h * 64448 / 6561, k3), h * -212 / 729, k4)
        k5 = compute_slope(radius, shape, ahead, w, normal, start_angle + turn * 8 / 9)
        ahead = advance(advance(y, h * 9017 / 3168, k1), h * -355 / 33, k2)
        ahead = advance(advance(advance(ahead, h * 46732 / 5247, k3), h * 49 / 176, k4), h * -5103 / 18656, k5)
        k6 = compute_slope(radius, shape, ahead, w, normal, start_angle + turn)
        ahead = advance(advance(advance(y, h * 35 / 384, k1), h * 500 / 1113, k3), h * 125 / 192, k4)
        ahead = advance(advance(ahead, h * -2187 / 6784, k5), h * 11 / 84, k6)
        k7 = compute_slope(radius, shape, ahead, w, normal, start_angle + turn)
        count += 6
        nothing = Coordinates(0.0, 0.0, 0.0, 0.0, 0.0)
        error_estimate = advance(advance(advance(nothing, 71 / 57600, k1), -71 / 16695, k3), 71 / 1920, k4)
        error_estimate = advance(advance(advance(error_estimate, -17253 / 339200, k5), 22 / 525, k6), -1 / 40, k7)
        error = h * find_largest(error_estimate, y, ahead)
        if error > RELATIVE_TOLERANCE:
            # Only the first failure in a row trusts the error estimate.
            h *= 0.5 if failed else max(0.1, 0.8 * (RELATIVE_TOLERANCE / error) ** 0.2)
            failed = True
            continue
        t, y, k1, is_done = t + h, ahead, k7, last
        if not failed:
            factor = 1.25 * (error / RELATIVE_TOLERANCE) ** 0.2
            h *= 1.0 / factor if factor > 0.2 else 5.0
        failed = False
    return y, count


@entry
def roll_classical(
    shape: Any, radius: float, start: Coordinates, steps: Steps, share: float, path: Array, watch: Stopwatch
) -> int:
    """Roll through the steps from the coordinates `start`, once for each block of `watch`.

    Every step stores the contact point in a row of `path` (n, 3). Returns the evaluations of the equations in a block.
    """
    turns, dt, spin_rate = steps
    count, normal = 0, compute_chart(shape, start.u_o, start.v_o).z
    for block in range(watch.ns.shape[0]):
        start_ns = read_clock_ns(watch.timespec)
        at, count = start, 0
        for i in range(turns.shape[0]):
            w = vec3.scale(1.0 / dt, rotations.log((turns[i, 0], turns[i, 1], turns[i, 2], turns[i, 3])))
            precession = Precession(w, normal, spin_rate * dt * i, spin_rate)
            at, evaluations = solve_ode45(radius, shape, at, precession, dt, share)
            count += evaluations
            path[i, 0], path[i, 1], path[i, 2] = compute_chart(shape, at.u_o, at.v_o).point
        watch.ns[block] = read_clock_ns(watch.timespec) - start_ns
    return count
