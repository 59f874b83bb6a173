"""Stick-slip: rolling while the contact sticks, sliding while it slips, and the transitions.

    stick_slip(law, torsion, coupling, k_tau, inputs) -> FrictionResult

One call resolves friction and torsion of a contact. `inputs` (FrictionInput) contains the tangential deflection e of
the proxy from the probe, the part p of it wound up by rolling, the wind-up phi, the normal force, and the state of the
last tick.
"""

from typing import Any

from softfinger.proxy.kernels.friction.laws import compute_cone, find_viscosity, measure_load, remove_direction
from softfinger.proxy.kernels.friction.limit_surface import compute_room
from softfinger.proxy.kernels.friction.stick_slip_of_paper import stick_slip_by_equations
from softfinger.proxy.kernels.friction.torsion import wind_up
from softfinger.proxy.kernels.friction.viscous_slip import SLIP_TIME_CONSTANT_S, slide_by_viscosity
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Coupling, FrictionInput, FrictionResult, PaperFriction, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.record import CAUSE_DRAG, CAUSE_NONE, CAUSE_REVERSE, CAUSE_STOP, CAUSE_THETA_MAX, ROLLING, SLIDING

STOP_SPEED_M_PER_S = 0.5e-3
"""Slip speed below which a finger that does not slip in this tick has stopped."""
REVERSE_SHARE = 0.1
"""Share of the deflection that must be unwound before a slide counts as reversed."""
REVERSE_STEPS = 3.0
"""Smallest unwinding for a reversal, in encoder steps: a resting hand may flicker by up to that."""
SLIP_TOLERANCE = 1e-9
"""Relative size of rounding: of a slip, as a share of the deflection; of a load, as a share of the cone and of the
radius."""


@jit
def stick_slip(
    law: Any, torsion: Any, coupling: Coupling, torque_stiffness: float, inputs: FrictionInput
) -> FrictionResult:
    if law is None:
        return slide_freely(torsion, coupling, inputs)
    if isinstance(law, PaperFriction):
        return stick_slip_by_equations(law, torsion, coupling, torque_stiffness, inputs)
    return stick_slip_by_law(law, torsion, coupling, torque_stiffness, inputs)


@jit
def slide_freely(torsion: Any, coupling: Coupling, inputs: FrictionInput) -> FrictionResult:
    """Resolve only torsion: without friction the proxy has no deflection from the probe and does not stick."""
    zero = (0.0, 0.0, 0.0)
    wind = wind_up(torsion, coupling.torsional_damping, inputs.spin, inputs.twist, inputs)
    return FrictionResult(
        mode=float(SLIDING), cause=float(CAUSE_NONE), deflection=zero, rolled_part=zero, slip_speed=0.0,
        slip_deflection=0.0, spin=wind.spin, spin_slip_speed=wind.slip_speed, spin_slip_angle=wind.slip_angle,
        force=zero, moment=wind.moment,
    )  # fmt: skip


@jit
def split_deflection(deflection: Vec3, rolled_part: Vec3) -> tuple[Vec3, Vec3]:
    """Return the parts of the deflection wound up by dragging (l) and by rolling (p); opposite parts cancel.

    The hand that follows a roll drags back exactly the deflection that rolling winds up, and both parts are zero.
    """
    dragged = vec3.sub(deflection, rolled_part)
    square = vec3.dot(rolled_part, rolled_part)
    if square > 0.0:
        share = min(max(-vec3.dot(dragged, rolled_part) / square, 0.0), 1.0)
        dragged = vec3.add_scaled(dragged, share, rolled_part)
        rolled_part = vec3.scale(1.0 - share, rolled_part)
    return dragged, rolled_part


@jit
def limit_force(law: Any, normal: Vec3, force: Vec3, largest: float) -> Vec3:
    """Scale `force` (3,) N so that its magnitude, as measured by the law, is at most `largest` N."""
    size = measure_load(law, normal, force)
    if size > largest:
        return vec3.scale(largest / size, force)
    return force


@jit
def limit_to_cone(law: Any, normal: Vec3, force: Vec3, normal_force: float, slip_speed: float) -> Vec3:
    """Limit `force` (3,) N to the friction cone of that normal force, N, and slip speed, m/s; not that of the paper."""
    if law is None:
        return (0.0, 0.0, 0.0)
    if isinstance(law, PaperFriction):
        return force
    static_limit, kinetic_limit = compute_cone(remove_direction(law), normal_force, slip_speed)
    return limit_force(law, normal, force, max(static_limit, kinetic_limit))


@jit
def find_start_of_sliding(
    law: Any,
    inputs: FrictionInput,
    stiffness: float,
    torque_stiffness: float,
    dragged: Vec3,
    rolled_part: Vec3,
    static_limit: float,
) -> float:
    """Return the cause of a transition to sliding, or CAUSE_NONE if the load is inside the static cone.

    The larger part of the load determines the cause: CAUSE_DRAG for dragging, CAUSE_THETA_MAX for rolling.
    """
    weighted_load = vec3.add_scaled(vec3.scale(stiffness, dragged), torque_stiffness, rolled_part)
    load = measure_load(law, inputs.normal, weighted_load)
    # A finger that slid with mu_d = mu_s stops on the cone: rounding must not make it slip again.
    if load > (1.0 + SLIP_TOLERANCE) * static_limit and load > SLIP_TOLERANCE * stiffness * inputs.radius:
        by_drag = stiffness * vec3.norm(dragged) >= torque_stiffness * vec3.norm(rolled_part)
        return float(CAUSE_DRAG) if by_drag else float(CAUSE_THETA_MAX)
    return float(CAUSE_NONE)


@jit
def find_end_of_sliding(
    law: Any,
    inputs: FrictionInput,
    load: Vec3,
    static_limit: float,
    slip_speed: float,
    slip_deflection: float,
    length: float,
) -> float:
    """Return CAUSE_STOP if the slip has stopped, CAUSE_REVERSE if the deflection has unwound, otherwise CAUSE_NONE.

    slip_speed       m/s  low-passed
    slip_deflection  m    length of the deflection at the last slip
    length           m    current length of the deflection
    """
    has_stopped, unwinding = slip_speed < STOP_SPEED_M_PER_S, slip_deflection - length
    if not has_stopped and unwinding <= max(REVERSE_SHARE * slip_deflection, REVERSE_STEPS * inputs.resolution):
        return float(CAUSE_NONE)
    # With viscous friction the load of a fast slip may exceed the static cone: the contact cannot stick yet.
    may_stick = measure_load(law, inputs.normal, load) <= (1.0 + SLIP_TOLERANCE) * static_limit
    if not may_stick:
        return float(CAUSE_NONE)
    return float(CAUSE_STOP) if has_stopped else float(CAUSE_REVERSE)


@jit
def stick_slip_by_law(
    law: Any, torsion: Any, coupling: Coupling, torque_stiffness: float, inputs: FrictionInput
) -> FrictionResult:
    """Resolve friction with the state machine of rolling and sliding.

    Rolling ends when the load K_t l + k_tau p leaves the static cone. This combines the paper's sign rule and its
    theta_max: a roll that the hand has not followed (p, theta = |p| / r) loads the cone like a drag in the same
    direction, and a roll that it has followed does not load it.
    While sliding, the deflection is reduced to the kinetic cone, never extended, so friction opposes the true slip.
    Sliding ends when the slip has stopped or reversed. With a limit surface, the moment about the normal reduces the
    cone, and friction and torsion slip together.

    Source: Salvietti et al. (2013), section 3.2, changed by docs/decisions/0003-state-machine.md.
    """
    stiffness = coupling.stiffness
    whole_limit, kinetic_limit = compute_cone(remove_direction(law), inputs.normal_force, inputs.slip_speed)
    static_limit = whole_limit * compute_room(torsion, inputs.spin + inputs.twist, inputs.normal_force)
    mode, cause, deflection, spin, twist = inputs.mode, float(CAUSE_NONE), inputs.deflection, inputs.spin, inputs.twist
    slip_speed, slip_deflection = inputs.slip_speed, inputs.slip_deflection
    dragged, rolled_part = split_deflection(deflection, inputs.rolled_part)

    limit, breaking = -1.0 if mode == ROLLING else kinetic_limit, 0.0
    if mode == ROLLING:
        cause = find_start_of_sliding(law, inputs, stiffness, torque_stiffness, dragged, rolled_part, static_limit)
        if cause != CAUSE_NONE:
            mode, limit, breaking = float(SLIDING), whole_limit, 1.0

    if limit >= 0.0:
        result = slide_by_viscosity(
            find_viscosity(remove_direction(law)), torsion, law, stiffness, limit, breaking, inputs
        )
        deflection, spin, twist, length = result.deflection, result.spin, result.twist, result.length
        rolled_part = (0.0, 0.0, 0.0)
        slips = result.slip > SLIP_TOLERANCE * length
        if slips or cause != CAUSE_NONE:
            slip_deflection = length
        speed = result.slip / inputs.dt if inputs.dt > 0.0 else 0.0
        if cause != CAUSE_NONE:
            slip_speed = speed
        else:
            slip_speed += (speed - slip_speed) * inputs.dt / (SLIP_TIME_CONSTANT_S + inputs.dt)
            if not slips:
                load = vec3.scale(stiffness, deflection)
                cause = find_end_of_sliding(law, inputs, load, static_limit, slip_speed, slip_deflection, length)
            if cause != CAUSE_NONE:
                mode, slip_speed = float(ROLLING), 0.0

    force = vec3.scale(stiffness, deflection)
    if mode == ROLLING and inputs.dt > 0.0:
        change = vec3.sub(deflection, inputs.deflection_before)
        force = vec3.add_scaled(force, coupling.damping / inputs.dt, change)
    if mode == ROLLING or breaking != 0.0:
        force = limit_force(law, inputs.normal, force, whole_limit if breaking != 0.0 else static_limit)
    wind = wind_up(torsion, coupling.torsional_damping, spin, twist, inputs)
    return FrictionResult(
        mode=mode, cause=cause, deflection=deflection, rolled_part=rolled_part, slip_speed=slip_speed,
        slip_deflection=slip_deflection, spin=wind.spin, spin_slip_speed=wind.slip_speed,
        spin_slip_angle=wind.slip_angle, force=force, moment=wind.moment,
    )  # fmt: skip
