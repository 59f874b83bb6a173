"""Exact integration of one axis of a plant over a tick, with Coulomb friction of the mechanism.

While the axis moves, friction is constant and opposes the velocity. At rest, it balances the other forces up to its
limit. So a tick is a sequence of linear pieces: motion in one direction, rest, motion in the other. A piece ends when
the velocity reaches zero, or when the balanced force reaches the limit; both times are exact to rounding, by a
bracketed Newton's method.

Most ticks have one piece, and `move` computes these with precomputed coefficients. `move_in_pieces` handles the others,
in substeps so short that a Taylor series is exact to rounding. If the velocity crosses zero in two separate intervals
of one substep (half a time constant of the fastest mode), only one of them is detected.
"""

from math import copysign, exp, log
from typing import Final, NamedTuple

from softfinger.proxy.kernels.jit.decorators import entry, jit

STOPS_MAX: Final = 64
"""Maximum number of stops in a tick; afterwards the axis rests until the next tick. Few ticks have more than two."""
SERIES_TERMS: Final = 24
"""Terms of the Taylor series: over half a time constant, the truncation error is below 1e-18 of the motion."""
ITERATIONS_MAX: Final = 80
"""Maximum iterations of a bracketed root search; bisection would need 53."""


class Axis(NamedTuple):
    """Axis, for ticks of a fixed length.

    With all inputs constant, a tick leads to
        x + x_z (x - p) + x_v v + x_a a + x_u u + x_w w + x_f f
            v_z (x - p) + v_v v + v_a a + v_u u + v_w w + v_f f
    with a the initial force of the motors and u, p, w, f the `Inputs`.

    friction                           N               Coulomb
    mobility                           1/kg            acceleration by 1 N
    damping, stiffness, hand_damping   1/s, 1/s^2, 1/s  over the moving mass
    lag_rate                           1/s             of the motors, 0 without lag
    period                             s
    substep                            s               longest piece for the Taylor series
    substep_without_lag                s               the same without the motors' lag
    """

    x_z: float
    x_v: float
    x_a: float
    x_u: float
    x_w: float
    x_f: float
    v_z: float
    v_v: float
    v_a: float
    v_u: float
    v_w: float
    v_f: float
    friction: float
    mobility: float
    damping: float
    stiffness: float
    hand_damping: float
    lag_rate: float
    period: float
    substep: float
    substep_without_lag: float


class Inputs(NamedTuple):
    """Inputs of an axis during a linear piece.

    u  N    command to the motors
    p  m    goal of the hand at the start of the piece
    w  m/s  speed of the goal
    f  N    force that bypasses the motors: friction
    """

    u: float
    p: float
    w: float
    f: float


@jit
def advance_inputs(inputs: Inputs, h: float) -> Inputs:
    """Return the inputs after `h` s: the goal has moved."""
    return Inputs(inputs.u, inputs.p + inputs.w * h, inputs.w, inputs.f)


@jit
def with_friction(axis: Axis, direction: float, inputs: Inputs) -> Inputs:
    """Return the inputs with friction against a motion in direction `direction`, 1 or -1."""
    return Inputs(inputs.u, inputs.p, inputs.w, -direction * axis.friction)


@jit
def move_freely(axis: Axis, x: float, v: float, a: float, inputs: Inputs) -> tuple[float, float]:
    """Return position and velocity after a full tick under constant forces: see `Axis`."""
    u, p, w, f = inputs
    z = x - p
    return (
        x + (axis.x_z * z + axis.x_v * v + axis.x_a * a + axis.x_u * u + axis.x_w * w + axis.x_f * f),
        axis.v_z * z + axis.v_v * v + axis.v_a * a + axis.v_u * u + axis.v_w * w + axis.v_f * f,
    )


@jit
def compute_acceleration(axis: Axis, x: float, v: float, a: float, inputs: Inputs) -> float:
    _, p, w, f = inputs
    return axis.mobility * (a + f) - axis.damping * v - axis.stiffness * (x - p) + axis.hand_damping * w


@jit
def may_reach_zero(direction: float, h: float, v0: float, c0: float, v1: float, c1: float) -> bool:
    """Return True if a velocity of sign `direction` at both ends of `h` s may reach zero between them.

    v0, c0, v1, c1  velocity and acceleration at the ends

    The minimum of the speed is above the intersection of the tangents at the ends: if that is above zero, so is the
    speed.
    """
    if not (direction * c0 < 0.0 and direction * c1 > 0.0):
        return False
    t = (v1 - c1 * h - v0) / (c0 - c1)
    return direction * (v0 + c0 * t) <= 0.0


@jit
def bound_deceleration(axis: Axis, direction: float, lag: float, lag1: float, c0: float, c1: float) -> float:
    """Return a bound of the acceleration against `direction` in a tick, m/s^2, at most 0; never too small in magnitude.

    lag, lag1         N      difference of the motors' force from its command at both ends
    c0, c1           m/s^2  acceleration at both ends

    The contribution of the motors decays at any rate. The remainder changes slowly, and is at most 1.5 times its value
    at the ends.
    """
    rest0, rest1 = direction * (c0 - axis.mobility * lag), direction * (c1 - axis.mobility * lag1)
    return 1.5 * min(rest0, rest1, 0.0) + min(direction * axis.mobility * lag, 0.0)


@jit
def move(axis: Axis, x: float, v: float, a: float, a1: float, inputs: Inputs) -> tuple[float, float]:
    """Return position (m) and velocity (m/s) after one tick.

    x, v    m, m/s  at its start
    a, a1   N       force of the motors at its start and end
    inputs          without friction, f = 0
    """
    if axis.friction == 0.0:
        return move_freely(axis, x, v, a, inputs)
    u, w = inputs.u, inputs.w
    h, limit = axis.period, axis.friction * axis.mobility
    initial_force = u if axis.lag_rate == 0.0 else a
    if v == 0.0:
        c0 = compute_acceleration(axis, x, 0.0, initial_force, inputs)
        c1 = compute_acceleration(axis, x, 0.0, a1, advance_inputs(inputs, h))
        turn0 = axis.mobility * axis.lag_rate * (u - a) + axis.stiffness * w
        turn1 = axis.mobility * axis.lag_rate * (u - a1) + axis.stiffness * w
        if abs(c0) <= limit and abs(c1) <= limit and turn0 * turn1 >= 0.0:
            return x, 0.0
    elif h <= axis.substep_without_lag:
        direction = copysign(1.0, v)
        moving = with_friction(axis, direction, inputs)
        x1, v1 = move_freely(axis, x, v, a, moving)
        if direction * v1 > 0.0:
            c0 = compute_acceleration(axis, x, v, initial_force, moving)
            c1 = compute_acceleration(axis, x1, v1, a1, advance_inputs(moving, h))
            if h <= axis.substep:
                if not may_reach_zero(direction, h, v, c0, v1, c1):
                    return x1, v1
            elif direction * v + h * bound_deceleration(axis, direction, initial_force - u, a1 - u, c0, c1) > 0.0:
                return x1, v1
    return move_in_pieces(axis, x, v, initial_force, inputs)


@entry  # called, not inlined into `move`: it is long and seldom used
def move_in_pieces(axis: Axis, x: float, v: float, a: float, inputs: Inputs) -> tuple[float, float]:
    """Return position and velocity after a tick with friction, divided where the axis stops, rests and breaks away."""
    remaining, stops = axis.period, 0
    direction = copysign(1.0, v) if v != 0.0 else 0.0
    while remaining > 0.0:
        if direction == 0.0:
            c = compute_acceleration(axis, x, 0.0, a, inputs)
            if abs(c) > axis.friction * axis.mobility and stops < STOPS_MAX:
                direction = copysign(1.0, c)
            else:
                rest_time, direction = time_to_break_away(axis, x, a, inputs, remaining)
                if stops >= STOPS_MAX:
                    rest_time, direction = remaining, 0.0
                a = inputs.u + (a - inputs.u) * exp(-axis.lag_rate * rest_time)
                inputs = advance_inputs(inputs, rest_time)
                remaining -= rest_time
                continue
        h, moving = min(remaining, axis.substep), with_friction(axis, direction, inputs)
        x1, v1, a1 = integrate_series(axis, x, v, a, moving, h)
        c0 = compute_acceleration(axis, x, v, a, moving)
        c1 = compute_acceleration(axis, x1, v1, a1, advance_inputs(moving, h))
        end = h
        # After breaking away the axis has zero velocity and, except for rounding, zero acceleration.
        if direction * v1 >= 0.0 and v != 0.0 and may_reach_zero(direction, h, v, c0, v1, c1):
            end = find_lowest_speed(axis, x, v, a, moving, h)
            x1, v1, a1 = integrate_series(axis, x, v, a, moving, end)
        if direction * v1 < 0.0:
            stops += 1
            h = time_to_stop(axis, x, v, a, moving, end)
            x1, _, a1 = integrate_series(axis, x, v, a, moving, h)
            v1, direction = 0.0, 0.0
        elif end < h:
            x1, v1, a1 = integrate_series(axis, x, v, a, moving, h)
        x, v, a = x1, v1, a1
        inputs = advance_inputs(inputs, h)
        remaining -= h
    return x, v


@jit
def integrate_series(axis: Axis, x: float, v: float, a: float, inputs: Inputs, h: float) -> tuple[float, float, float]:
    """Return position, velocity and force of the motors after `h` s of a linear piece, at most `axis.substep`."""
    lag = inputs.u - a
    dx, dv, da = v, compute_acceleration(axis, x, v, a, inputs), axis.lag_rate * lag
    # The goal has only a first derivative; the higher ones of x and x - p are equal.
    dz = v - inputs.w
    share = h
    for n in range(2, SERIES_TERMS):
        x += share * dx
        v += share * dv
        a += share * da
        dx, dz, dv, da = (dv, dv, axis.mobility * da - axis.damping * dv - axis.stiffness * dz, -axis.lag_rate * da)
        share *= h / n
    return x, v, a


@jit
def time_to_stop(axis: Axis, x: float, v: float, a: float, inputs: Inputs, h: float) -> float:
    """Return the first zero of the velocity that friction `inputs.f` opposes; after `h` s it has changed sign."""
    direction = -copysign(1.0, inputs.f)
    low, high = 0.0, h
    t = 0.5 * h
    for _ in range(ITERATIONS_MAX):
        xt, vt, at = integrate_series(axis, x, v, a, inputs, t)
        if direction * vt > 0.0:
            low = t
        else:
            high = t
        slope = compute_acceleration(axis, xt, vt, at, advance_inputs(inputs, t))
        next_t = t - vt / slope if slope != 0.0 else low
        if not low < next_t < high:
            next_t = 0.5 * (low + high)
        if next_t == t or next_t <= low or next_t >= high:
            break
        t = next_t
    return t


@jit
def find_lowest_speed(axis: Axis, x: float, v: float, a: float, inputs: Inputs, h: float) -> float:
    """Return the time of the lowest speed within `h` s, or a time at which the velocity has changed sign already."""
    direction = -copysign(1.0, inputs.f)
    low, high = 0.0, h
    t = 0.5 * h
    for _ in range(ITERATIONS_MAX):
        xt, vt, at = integrate_series(axis, x, v, a, inputs, t)
        if direction * vt < 0.0:
            break
        if direction * compute_acceleration(axis, xt, vt, at, advance_inputs(inputs, t)) < 0.0:
            low = t
        else:
            high = t
        t = 0.5 * (low + high)
        if t <= low or t >= high:
            break
    return t


@jit
def time_to_break_away(axis: Axis, x: float, a: float, inputs: Inputs, remaining: float) -> tuple[float, float]:
    """Return the time until the axis breaks away, at most `remaining` s, and the direction, 0 if it does not.

    inputs  without friction, f = 0

    The driving force over the mass is mobility (u + (a - u) exp(-t / tau)) + stiffness (p + w t - x) + hand_damping w.
    It has at most one extremum; the search is before it, then after it.
    """
    limit, rate = axis.friction * axis.mobility, axis.lag_rate
    drive, ramp = axis.mobility * (a - inputs.u), axis.stiffness * inputs.w
    steady = compute_acceleration(axis, x, 0.0, inputs.u, inputs)
    turn = remaining
    if rate * drive * ramp > 0.0 and abs(ramp) < abs(rate * drive):
        turn = min(remaining, log(rate * drive / ramp) / rate)
    start = 0.0
    for end in (turn, remaining):
        last = steady + ramp * end + drive * exp(-rate * end)
        if abs(last) > limit:
            direction = copysign(1.0, last)
            low, high, t = start, end, 0.5 * (start + end)
            for _ in range(ITERATIONS_MAX):
                fading = drive * exp(-rate * t)
                over = direction * (steady + ramp * t + fading) - limit
                if over > 0.0:
                    high = t
                else:
                    low = t
                slope = direction * (ramp - rate * fading)
                next_t = t - over / slope if slope != 0.0 else low
                if not low < next_t < high:
                    next_t = 0.5 * (low + high)
                if next_t == t or next_t <= low or next_t >= high:
                    break
                t = next_t
            return t, direction
        start = end
    return remaining, 0.0
