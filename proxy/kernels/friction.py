"""Rolling, sliding and the passage between them.

    hold(law, torsion, coupling, k_tau, tick) -> Hold

One call resolves friction and torsion: `tick` is what the contact brings into this tick, among it the
tangential deflection e of the proxy from the probe, the share p of it that rolling has wound, the
wind-up phi, the normal force, and what the last tick left.
"""

from typing import Any

from softfinger.proxy.kernels import vec3
from softfinger.proxy.kernels.cones import cone, load_size
from softfinger.proxy.kernels.dispatch import by_type
from softfinger.proxy.kernels.jit import jit
from softfinger.proxy.kernels.limit_surface import room, slide
from softfinger.proxy.kernels.model import (
    Anisotropic,
    Coupling,
    Friction,
    Hold,
    PaperFriction,
    SpeedFriction,
    Tick,
    Vec3,
)
from softfinger.proxy.kernels.paper_machine import hold_to_the_letter
from softfinger.proxy.kernels.torsion import wind
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
"""Relative size of what is rounding and not motion: of the deflection for a slip, of the cone and of the
radius for a load."""


@by_type
def hold(law: Any, torsion: Any, coupling: Coupling, torque_stiffness: float, tick: Tick) -> Any: ...


@by_type
def static_coefficient(law: Any) -> Any:
    """mu_s, in a direction where the law's scale is 1; 0 without friction."""


@hold.of(None)
def slide_freely(law: None, torsion: Any, coupling: Coupling, torque_stiffness: float, tick: Tick) -> Hold:
    """Without friction the proxy is the foot of the probe: no deflection, no state machine. It still winds."""
    zero = (0.0, 0.0, 0.0)
    wound = wind(torsion, tick.spin, tick.twist, tick.normal_force, tick.spin_slip_speed, tick.spin_slip_angle, tick.dt)
    return Hold(
        float(SLIDING), float(CAUSE_NONE), zero, zero, 0.0, 0.0,
        wound.spin, wound.slip_speed, wound.slip_angle, zero, wound.moment,
    )  # fmt: skip


@static_coefficient.of(None)
def no_static_coefficient(law: None) -> float:
    return 0.0


@static_coefficient.of(Friction)
def static_coefficient_of_coulomb(law: Friction) -> float:
    return law.static


@static_coefficient.of(SpeedFriction)
def static_coefficient_with_speed(law: SpeedFriction) -> float:
    return law.static


@static_coefficient.of(Anisotropic)
def static_coefficient_of_anisotropic(law: Anisotropic) -> float:
    return static_coefficient(law.law)


@static_coefficient.of(PaperFriction)
def static_coefficient_in_the_paper(law: PaperFriction) -> float:
    return law.static


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
def limit_force(law: Any, normal: Vec3, force: Vec3, largest: float) -> Vec3:
    """`force` with its magnitude, as the law measures it, brought down to `largest`."""
    size = load_size(law, normal, force)
    if size > largest:
        return vec3.scale(largest / size, force)
    return force


@jit
def hold_by(law: Any, torsion: Any, coupling: Coupling, torque_stiffness: float, tick: Tick) -> Hold:
    """Friction with the rolling / sliding machine.

    Rolling ends when the load K_t l + k_tau p leaves the static cone, which is the paper's sign rule
    and its theta_max in one: a roll that the hand has not followed (p, theta = |p| / r) loads the cone
    like a drag in the same direction, and a roll that it has followed does not load it at all.
    While sliding the deflection is cut back to the kinetic cone, never extended, so friction opposes the
    true slip. Sliding ends when the slip has stopped or turned back. With a limit surface the cone is
    what the moment about the normal leaves of it, and a slip is one of both.

    Source: Salvietti et al. (2013), section 3.2, after Yin et al. (2005). Differs from its conditions
    read literally, which a counter-tilt of a microradian defeats; see docs/decisions/0003-state-machine.md.
    """
    stiffness = coupling.stiffness
    whole_limit, kinetic_limit = cone(law, tick.normal_force, tick.slip_speed)
    static_limit = whole_limit * room(torsion, tick.spin + tick.twist, tick.normal_force)
    mode, cause = tick.mode, float(CAUSE_NONE)
    deflection, spin, twist = tick.deflection, tick.spin, tick.twist
    slip_speed, slip_deflection = tick.slip_speed, tick.slip_deflection
    dragged, rolled_part = split(deflection, tick.rolled_part)

    limit, breaking = -1.0, 0.0
    if mode == ROLLING:
        wound = vec3.add_scaled(vec3.scale(stiffness, dragged), torque_stiffness, rolled_part)
        load = load_size(law, tick.normal, wound)
        # More than rounding above the cone: a finger at rest on it, as after a slide with mu_d = mu_s, stays at rest.
        if load > (1.0 + ROUNDING) * static_limit and load > ROUNDING * stiffness * tick.radius:
            mode, limit, breaking = float(SLIDING), whole_limit, 1.0
            by_drag = stiffness * vec3.norm(dragged) >= torque_stiffness * vec3.norm(rolled_part)
            cause = float(CAUSE_DRAG) if by_drag else float(CAUSE_THETA_MAX)
    else:
        limit = kinetic_limit

    if limit >= 0.0:
        slid = slide(torsion, law, stiffness, limit, breaking, tick)
        deflection, spin, twist, length = slid.deflection, slid.spin, slid.twist, slid.length
        rolled_part = (0.0, 0.0, 0.0)
        slips = slid.slip > ROUNDING * length
        if slips or cause != CAUSE_NONE:
            slip_deflection = length
        speed = slid.slip / tick.dt if tick.dt > 0.0 else 0.0
        if cause != CAUSE_NONE:
            slip_speed = speed
        else:
            slip_speed += (speed - slip_speed) * tick.dt / (SLIP_TIME_CONSTANT_S + tick.dt)
            unwound = slip_deflection - length
            stopped = slip_speed < STOP_SPEED_M_PER_S
            reversed_ = unwound > max(REVERSE_SHARE * slip_deflection, REVERSE_STEPS * tick.resolution)
            # With viscous friction a fast slip may hold more than the static cone does: it cannot stick yet.
            if (
                not slips
                and (stopped or reversed_)
                and (load_size(law, tick.normal, vec3.scale(stiffness, deflection)) <= (1.0 + ROUNDING) * static_limit)
            ):
                mode, slip_speed = float(ROLLING), 0.0
                cause = float(CAUSE_STOP) if stopped else float(CAUSE_REVERSE)

    force = vec3.scale(stiffness, deflection)
    if mode == ROLLING and tick.dt > 0.0:
        change = vec3.sub(deflection, tick.deflection_before)
        force = vec3.add_scaled(force, coupling.damping / tick.dt, change)
    if mode == ROLLING or breaking != 0.0:
        force = limit_force(law, tick.normal, force, whole_limit if breaking != 0.0 else static_limit)
    now = wind(torsion, spin, twist, tick.normal_force, tick.spin_slip_speed, tick.spin_slip_angle, tick.dt)
    return Hold(
        mode, cause, deflection, rolled_part, slip_speed, slip_deflection,
        now.spin, now.slip_speed, now.slip_angle, force, now.moment,
    )  # fmt: skip


@hold.of(Friction)
def hold_coulomb(law: Friction, torsion: Any, coupling: Coupling, torque_stiffness: float, tick: Tick) -> Hold:
    return hold_by(law, torsion, coupling, torque_stiffness, tick)


@hold.of(SpeedFriction)
def hold_with_speed(law: SpeedFriction, torsion: Any, coupling: Coupling, torque_stiffness: float, tick: Tick) -> Hold:
    return hold_by(law, torsion, coupling, torque_stiffness, tick)


@hold.of(Anisotropic)
def hold_anisotropic(law: Anisotropic, torsion: Any, coupling: Coupling, torque_stiffness: float, tick: Tick) -> Hold:
    return hold_by(law, torsion, coupling, torque_stiffness, tick)


@hold.of(PaperFriction)
def hold_as_in_the_paper(
    law: PaperFriction, torsion: Any, coupling: Coupling, torque_stiffness: float, tick: Tick
) -> Hold:
    return hold_to_the_letter(law, torsion, coupling, torque_stiffness, tick)
