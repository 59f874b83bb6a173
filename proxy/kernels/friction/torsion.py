"""Spin moment of a soft finger: a torsional spring with an anchor that slips at the torsional limit.

    wind_up(torsion, damping, spin, twist, inputs) -> TorsionResult

Positive spin is right-handed about the normal; the moment on the hand opposes it.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import FrictionInput, LimitSurface, PatchTorsion, PowerTorsion, SoftFingerProxy

SPIN_SLIP_TIME_CONSTANT_S = 0.010
"""Time constant of the low-pass of the anchor's slip, equal to that of the tangential slip."""
STOP_SPIN_RAD_PER_S = 0.05
"""Slip speed below which an anchor that does not slip in this tick has stopped: 0.5 mm/s at the skin of a 10 mm
finger."""
SPIN_REVERSE_SHARE = 0.1
"""Fraction of the wind-up that must be unwound before a spinning slip counts as reversed."""
SPIN_TOLERANCE = 1e-9
"""Relative slip below which it is rounding."""
MIN_SLIP_SPEED = 1e-300
"""Smallest slip speed of a slipping anchor: not zero, which is the slip speed of one that sticks."""


class TorsionResult(NamedTuple):
    """Wind-up phi, rad, moment about the normal on the hand, N m, and the anchor's slip (see `ContactState`)."""

    spin: float
    moment: float
    slip_speed: float
    slip_angle: float


@jit
def find_spring(torsion: Any) -> Any:
    """Return the law of the torsional spring, without the limit surface or the proxy that contains it."""
    return torsion.law if isinstance(torsion, (LimitSurface, SoftFingerProxy)) else torsion


@jit
def compute_torsional_limit(spring: Any, normal_force: float) -> float:
    """Return the largest moment about the normal, N m, under a normal force.

    PowerTorsion is for a contact patch with a radius ~ f_N^gamma (Xydas and Kao, 1999; gamma = 1/3 is Hertz's).
    """
    limit: float = spring.friction_length * normal_force
    return limit * normal_force**spring.exponent if isinstance(spring, PowerTorsion) else limit


@jit
def find_torsional_stiffness(spring: Any) -> float:
    """Return k_z, N m/rad.

    1 without torsion, for comparisons, and for a patch: its wind-up includes the root of its stiffness, see
    `contact_patch.compute_winding_unit`.
    """
    return 1.0 if spring is None or isinstance(spring, PatchTorsion) else spring.stiffness


@jit
def scale_torsion(torsion: Any, factor: float) -> Any:
    """Return the law for friction multiplied by `factor`: the torsional limit is due to friction."""
    if isinstance(torsion, (LimitSurface, SoftFingerProxy)):
        return replace(torsion, "law", scale_limit_of_spring(torsion.law, factor))
    return scale_limit_of_spring(torsion, factor)


@jit
def scale_limit_of_spring(spring: Any, factor: float) -> Any:
    if spring is None:
        return spring
    if isinstance(spring, PatchTorsion):
        return PatchTorsion(factor * spring.friction)
    return replace(spring, "friction_length", factor * spring.friction_length)


@jit
def scale_stiffness(torsion: Any, share: float) -> Any:
    """Return the law with this share of the spring.

    The limit of every law, and the spring of a patch, follow from the normal force of the contact.
    """
    if isinstance(torsion, (LimitSurface, SoftFingerProxy)):
        return replace(torsion, "law", scale_stiffness_of_spring(torsion.law, share))
    return scale_stiffness_of_spring(torsion, share)


@jit
def scale_stiffness_of_spring(spring: Any, share: float) -> Any:
    if spring is None or isinstance(spring, PatchTorsion):
        return spring
    return replace(spring, "stiffness", share * spring.stiffness)


@jit
def wind_up(torsion: Any, damping: float, spin: float, twist: float, inputs: FrictionInput) -> TorsionResult:
    """Return the state of the spring after a rotation of `twist` rad about the normal.

    The moment is that of the spring and of a parallel damper (N m s/rad), clamped to the torsional limit. Only a change
    of the wind-up in this tick is damped, not the slip of the anchor. On a limit surface, `slide` has already limited
    phi: the limit here is the one without a tangential force.
    """
    if torsion is None:
        return TorsionResult(0.0, 0.0, 0.0, 0.0)
    if isinstance(torsion, SoftFingerProxy):
        result = wind_soft_finger(torsion, spin, twist, inputs)
    else:
        result = wind_spring(find_spring(torsion), spin, twist, inputs)
    if damping == 0.0 or inputs.dt <= 0.0:
        return result
    limit = compute_torsional_limit(find_spring(torsion), inputs.normal_force)
    moment = result.moment - damping * (result.spin - inputs.spin) / inputs.dt
    return replace(result, "moment", min(max(moment, -limit), limit))


@jit
def wind_spring(spring: Any, spin: float, twist: float, inputs: FrictionInput) -> TorsionResult:
    """Compute tau_n = k_z phi, its magnitude at most the torsional limit; the anchor slips by the excess.

    Source: Salvietti et al. (2013), eq. 1; the paper has no limit.
    """
    stiffness = find_torsional_stiffness(spring)
    limit = compute_torsional_limit(spring, inputs.normal_force) / stiffness
    angle = min(max(spin + twist, -limit), limit)
    return TorsionResult(angle, -stiffness * angle, 0.0, 0.0)


@jit
def wind_soft_finger(torsion: SoftFingerProxy, spin: float, twist: float, inputs: FrictionInput) -> TorsionResult:
    """Compute the proxy's fourth degree of freedom: its angle about the normal sticks, or slips behind the probe's.

    phi is the probe's angle minus the proxy's. The proxy sticks while k_z |phi| is within the static torsional cone;
    outside it the proxy follows the probe such that k_z |phi| is the kinetic limit, until the slip has stopped or
    reversed. In the tick of the transition to slip the moment is the static limit. The cone of the translation is
    separate and independent.

    Source: Barbagli, Frisoli, Salisbury, Bergamasco (2004). Differs from it in ending a slip as tangential
    friction does here (band at standstill, fraction of unwinding) and not only by the cone.
    """
    stiffness = find_torsional_stiffness(torsion.law)
    static_limit = compute_torsional_limit(torsion.law, inputs.normal_force) / stiffness
    slip_speed, slip_angle, dt = inputs.spin_slip_speed, inputs.spin_slip_angle, inputs.dt
    sticks = slip_speed == 0.0
    limit = static_limit if sticks else torsion.kinetic_share * static_limit
    angle = spin + twist
    slip = max(abs(angle) - limit, 0.0)
    angle = min(max(angle, -limit), limit)
    slips = slip > SPIN_TOLERANCE * limit
    speed = slip / dt if dt > 0.0 else 0.0
    if sticks:
        if slips:
            slip_speed, slip_angle = max(speed, MIN_SLIP_SPEED), abs(angle)
    else:
        if slips:
            slip_angle = abs(angle)
        slip_speed = max(slip_speed + (speed - slip_speed) * dt / (SPIN_SLIP_TIME_CONSTANT_S + dt), MIN_SLIP_SPEED)
        has_stopped = slip_speed < STOP_SPIN_RAD_PER_S
        has_reversed = slip_angle - abs(angle) > SPIN_REVERSE_SHARE * slip_angle
        if not slips and (has_stopped or has_reversed):
            slip_speed = 0.0
    return TorsionResult(angle, -stiffness * angle, slip_speed, slip_angle)
