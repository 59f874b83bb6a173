"""Rolling, sliding and the passage between them.

    hold(friction, coupling, k_tau, tick) -> Hold

`tick` is what the contact brings into this tick: the tangential deflection e of the proxy from the
probe, the share p of it that rolling has wound, the normal force, and what the last tick left.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels import vec3
from softfinger.proxy.kernels.dispatch import by_type
from softfinger.proxy.kernels.jit import jit
from softfinger.proxy.kernels.model import Coupling, Friction, Vec3
from softfinger.proxy.state import (
    CAUSE_DRAG,
    CAUSE_NONE,
    CAUSE_REVERSE,
    CAUSE_STOP,
    CAUSE_THETA_MAX,
    ROLLING,
    SLIDING,
)

SLIP_TIME_CONSTANT_S = 0.010
"""Low-pass of the plastic slip speed: shorter than a tremor's period, longer than an encoder's steps."""
STOP_SPEED_M_PER_S = 0.5e-3
"""Below this slip speed a finger that does not slip in this tick has stopped."""
REVERSE_SHARE = 0.1
"""Share of the deflection that must be unwound before a slide counts as reversed."""
REVERSE_STEPS = 3.0
"""... and at least so many encoder steps, which a resting hand may flicker by."""
ROUNDING = 1e-9
"""Relative size of what is rounding and not motion: of the deflection for a slip, of the radius for a load."""


class Tick(NamedTuple):
    """Input of `hold`: see `State` for the names; `touched` is 1 on the tick of first contact."""

    radius: float
    resolution: float
    dt: float
    touched: float
    mode: float
    deflection: Vec3
    deflection_before: Vec3
    rolled_part: Vec3
    slip_speed: float
    slip_deflection: float
    normal_force: float


class Hold(NamedTuple):
    """Output of `hold`: the new mode and why, the deflection kept, the tangential force on the hand."""

    mode: float
    cause: float
    deflection: Vec3
    rolled_part: Vec3
    slip_speed: float
    slip_deflection: float
    force: Vec3


@by_type
def hold(friction: Any, coupling: Coupling, torque_stiffness: float, tick: Tick) -> Any: ...


@hold.of(None)
def slide_freely(friction: None, coupling: Coupling, torque_stiffness: float, tick: Tick) -> Hold:
    """Without friction the proxy is the foot of the probe: no deflection, no state machine."""
    zero = (0.0, 0.0, 0.0)
    return Hold(float(SLIDING), float(CAUSE_NONE), zero, zero, 0.0, 0.0, zero)


@jit
def split(deflection: Vec3, rolled_part: Vec3) -> tuple[Vec3, Vec3]:
    """Shares of the deflection wound by dragging (l) and by rolling (p); opposite parts cancel.

    A finger that follows its roll drags back exactly what rolling winds, and then neither is left.
    """
    dragged = vec3.sub(deflection, rolled_part)
    square = vec3.dot(rolled_part, rolled_part)
    if square > 0.0:
        share = min(max(-vec3.dot(dragged, rolled_part) / square, 0.0), 1.0)
        dragged = vec3.add_scaled(dragged, share, rolled_part)
        rolled_part = vec3.scale(1.0 - share, rolled_part)
    return dragged, rolled_part


@jit
def limit_force(force: Vec3, largest: float) -> Vec3:
    """`force` with its magnitude brought down to `largest`."""
    size = vec3.norm(force)
    if size > largest:
        return vec3.scale(largest / size, force)
    return force


@hold.of(Friction)
def hold_coulomb(friction: Friction, coupling: Coupling, torque_stiffness: float, tick: Tick) -> Hold:
    """Coulomb friction with the rolling / sliding machine.

    Rolling ends when the load K_t l + k_tau p leaves the static cone, which is the paper's sign rule
    and its theta_max in one: a roll that the hand has not followed (p, theta = |p| / r) loads the cone
    like a drag in the same direction, and a roll that it has followed does not load it at all.
    While sliding the deflection is cut back radially to mu_d f_N / K_t, never extended, so friction
    opposes the true slip. Sliding ends when the slip has stopped or turned back.

    Source: Salvietti et al. (2013), section 3.2, after Yin et al. (2005). Differs from its conditions
    read literally, which a counter-tilt of a microradian defeats; see docs/decisions/0003-state-machine.md.
    """
    stiffness = coupling.stiffness
    static_limit = friction.static * tick.normal_force
    mode, cause = tick.mode, float(CAUSE_NONE)
    deflection = tick.deflection
    slip_speed, slip_deflection = tick.slip_speed, tick.slip_deflection
    dragged, rolled_part = split(deflection, tick.rolled_part)

    limit = -1.0
    if mode == ROLLING:
        load = vec3.norm(vec3.add_scaled(vec3.scale(stiffness, dragged), torque_stiffness, rolled_part))
        if load >= static_limit and load > ROUNDING * stiffness * tick.radius:
            mode, limit = float(SLIDING), static_limit
            by_drag = stiffness * vec3.norm(dragged) >= torque_stiffness * vec3.norm(rolled_part)
            cause = float(CAUSE_DRAG) if by_drag else float(CAUSE_THETA_MAX)
    else:
        limit = friction.kinetic * tick.normal_force

    if limit >= 0.0:
        length, longest = vec3.norm(deflection), limit / stiffness
        slip = max(length - longest, 0.0)
        if slip > 0.0:
            deflection = vec3.scale(longest / length, deflection)
            length = longest
        rolled_part = (0.0, 0.0, 0.0)
        slips = slip > ROUNDING * length
        if slips or cause != CAUSE_NONE:
            slip_deflection = length
        speed = slip / tick.dt if tick.dt > 0.0 else 0.0
        if cause != CAUSE_NONE:
            slip_speed = speed
        else:
            slip_speed += (speed - slip_speed) * tick.dt / (SLIP_TIME_CONSTANT_S + tick.dt)
            unwound = slip_deflection - length
            if not slips and slip_speed < STOP_SPEED_M_PER_S:
                mode, cause, slip_speed = float(ROLLING), float(CAUSE_STOP), 0.0
            elif not slips and unwound > max(REVERSE_SHARE * slip_deflection, REVERSE_STEPS * tick.resolution):
                mode, cause, slip_speed = float(ROLLING), float(CAUSE_REVERSE), 0.0

    force = vec3.scale(stiffness, deflection)
    if mode == ROLLING and tick.touched == 0.0 and tick.dt > 0.0:
        change = vec3.sub(deflection, tick.deflection_before)
        force = vec3.add_scaled(force, coupling.damping / tick.dt, change)
    force = limit_force(force, static_limit)
    return Hold(mode, cause, deflection, rolled_part, slip_speed, slip_deflection, force)
