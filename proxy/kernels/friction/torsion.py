"""Spin moment of a soft finger: a torsional spring with an anchor that slips at the torsional limit.

    wind_up(torsion, spin, turn, inputs) -> TorsionResult

Positive spin is right-handed about the normal; the moment on the hand opposes it.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import (
    FrictionInput,
    LimitSurface,
    PatchTorsion,
    PowerTorsion,
    SoftFingerProxy,
    Torsion,
)

SPIN_SLIP_TIME_CONSTANT_S = 0.010
"""Time constant of the low-pass of the anchor's slip, equal to that of the tangential slip."""
STOP_SPIN_RAD_PER_S = 0.05
"""Slip speed below which an anchor that does not slip in this tick has stopped: 0.5 mm/s at the skin of a 10 mm
finger."""
SPIN_REVERSE_SHARE = 0.1
"""Fraction of the wind-up that must be unwound before a spinning slip counts as reversed."""
SPIN_ROUNDING = 1e-9
"""Relative slip below which it is rounding."""
SLOWEST = 1e-300
"""Smallest slip speed of a slipping anchor: not zero, which is the slip speed of one that sticks."""


class TorsionResult(NamedTuple):
    """Wind-up phi, rad, moment about the normal on the hand, N m, and the anchor's slip (see `ContactState`)."""

    spin: float
    moment: float
    slip_speed: float
    slip_angle: float


@by_type
def torsional_limit(torsion: Any, normal_force: float) -> Any:
    """Return the largest moment about the normal, N m, under a normal force."""


@torsional_limit.of(Torsion)
def linear_limit(torsion: Torsion, normal_force: float) -> float:
    return torsion.friction_length * normal_force


@torsional_limit.of(PowerTorsion)
def power_limit(torsion: PowerTorsion, normal_force: float) -> float:
    """Return the limit of a contact patch that grows with the load.

    Radius ~ f_N^gamma (Xydas and Kao, 1999; gamma = 1/3 is Hertz's).
    """
    return torsion.friction_length * normal_force * normal_force**torsion.exponent


@torsional_limit.of(LimitSurface, SoftFingerProxy)
def limit_of_law(torsion: Any, normal_force: float) -> Any:
    return torsional_limit(torsion.law, normal_force)


@by_type
def torsional_stiffness(torsion: Any) -> Any:
    """Return k_z, N m/rad.

    1 without torsion, for comparisons, and for a patch: its wind-up includes the root of its stiffness, see
    `contact_patch.winding_unit`.
    """


@torsional_stiffness.of(Torsion, PowerTorsion)
def stiffness_of_spring(torsion: Any) -> float:
    stiffness: float = torsion.stiffness
    return stiffness


@torsional_stiffness.of(None, PatchTorsion)
def unit_stiffness(torsion: Any) -> float:
    return 1.0


@torsional_stiffness.of(LimitSurface, SoftFingerProxy)
def stiffness_of_law(torsion: Any) -> float:
    return torsional_stiffness(torsion.law)


@by_type
def with_scaled_friction(torsion: Any, factor: float) -> Any:
    """Return the law for friction multiplied by `factor`: the torsional limit is due to friction."""


@with_scaled_friction.of(None)
def scale_no_torsion(torsion: None, factor: float) -> None:
    return torsion


@with_scaled_friction.of(Torsion, PowerTorsion)
def scale_spring(torsion: Any, factor: float) -> Any:
    return replace(torsion, "friction_length", factor * torsion.friction_length)


@with_scaled_friction.of(PatchTorsion)
def scale_patch(torsion: PatchTorsion, factor: float) -> PatchTorsion:
    return PatchTorsion(factor * torsion.friction)


@with_scaled_friction.of(LimitSurface, SoftFingerProxy)
def scale_law_of(torsion: Any, factor: float) -> Any:
    return replace(torsion, "law", with_scaled_friction(torsion.law, factor))


@by_type
def share_of(torsion: Any, share: float) -> Any:
    """Return the law with this share of the spring.

    The limit of every law, and the spring of a patch, follow from the normal force of the contact.
    """


@share_of.of(Torsion, PowerTorsion)
def share_of_spring(torsion: Any, share: float) -> Any:
    return replace(torsion, "stiffness", share * torsion.stiffness)


@share_of.of(None, PatchTorsion)
def share_of_patch(torsion: Any, share: float) -> Any:
    return torsion


@share_of.of(LimitSurface, SoftFingerProxy)
def share_of_law(torsion: Any, share: float) -> Any:
    return replace(torsion, "law", share_of(torsion.law, share))


@jit
def damp_moment(torsion: Any, damping: float, moment: float, wound: float, inputs: FrictionInput) -> float:
    """Return the moment of spring and parallel damper, N m, clamped to the torsional limit.

    damping  N m s/rad
    wound    rad        change of the wind-up in this tick: a slipping anchor does not damp
    """
    if torsion is None or damping == 0.0 or inputs.dt <= 0.0:
        return moment
    limit = torsional_limit(torsion, inputs.normal_force)
    both: float = min(max(moment - damping * wound / inputs.dt, -limit), limit)
    return both


@by_type
def wind_up(torsion: Any, spin: float, turn: float, inputs: FrictionInput) -> Any:
    """Return the state of the spring after a rotation of `turn` rad about the normal."""


@wind_up.of(None)
def wind_nothing(torsion: None, spin: float, turn: float, inputs: FrictionInput) -> TorsionResult:
    return TorsionResult(0.0, 0.0, 0.0, 0.0)


@wind_up.of(Torsion, PowerTorsion)
def wind_spring(torsion: Any, spin: float, turn: float, inputs: FrictionInput) -> TorsionResult:
    """Compute tau_n = k_z phi, its magnitude at most the torsional limit; the anchor slips by the excess.

    Source: Salvietti et al. (2013), eq. 1; the paper has no limit.
    """
    stiffness = torsional_stiffness(torsion)
    limit = torsional_limit(torsion, inputs.normal_force) / stiffness
    angle = min(max(spin + turn, -limit), limit)
    return TorsionResult(angle, -stiffness * angle, 0.0, 0.0)


@wind_up.of(LimitSurface)
def wind_limit_surface(torsion: Any, spin: float, turn: float, inputs: FrictionInput) -> TorsionResult:
    """Apply the limit surface without a tangential load; with one, `slide` has already limited phi."""
    return wind_spring(torsion.law, spin, turn, inputs)


@wind_up.of(SoftFingerProxy)
def wind_soft_finger(torsion: Any, spin: float, turn: float, inputs: FrictionInput) -> TorsionResult:
    """Compute the proxy's fourth degree of freedom: its angle about the normal sticks, or slips behind the probe's.

    phi is the probe's angle minus the proxy's. The proxy sticks while k_z |phi| is within the static torsional cone;
    outside it the proxy follows the probe such that k_z |phi| is the kinetic limit, until the slip has stopped or
    reversed. In the tick of the transition to slip the moment is the static limit. The cone of the translation is
    separate and independent.

    Source: Barbagli, Frisoli, Salisbury, Bergamasco (2004). Differs from it in ending a slip as tangential
    friction does here (band at standstill, fraction of unwinding) and not only by the cone.
    """
    stiffness = torsional_stiffness(torsion.law)
    static_limit = torsional_limit(torsion.law, inputs.normal_force) / stiffness
    slip_speed, slip_angle, dt = inputs.spin_slip_speed, inputs.spin_slip_angle, inputs.dt
    sticks = slip_speed == 0.0
    limit = static_limit if sticks else torsion.kinetic_share * static_limit
    angle = spin + turn
    slip = max(abs(angle) - limit, 0.0)
    angle = min(max(angle, -limit), limit)
    slips = slip > SPIN_ROUNDING * limit
    speed = slip / dt if dt > 0.0 else 0.0
    if sticks:
        if slips:
            slip_speed, slip_angle = max(speed, SLOWEST), abs(angle)
    else:
        if slips:
            slip_angle = abs(angle)
        slip_speed = max(slip_speed + (speed - slip_speed) * dt / (SPIN_SLIP_TIME_CONSTANT_S + dt), SLOWEST)
        has_stopped = slip_speed < STOP_SPIN_RAD_PER_S
        has_reversed = slip_angle - abs(angle) > SPIN_REVERSE_SHARE * slip_angle
        if not slips and (has_stopped or has_reversed):
            slip_speed = 0.0
    return TorsionResult(angle, -stiffness * angle, slip_speed, slip_angle)
