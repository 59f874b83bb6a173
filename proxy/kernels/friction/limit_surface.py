"""Slip of deflection and wind-up, with separate limits of friction and torsion or with a common one.

compute_room(torsion, spin, normal_force) -> 1                  fraction of the static cone that torsion does not use
slide(torsion, law, stiffness, limit, breaking, inputs) -> Slide
"""

from math import sqrt
from typing import Any, NamedTuple

from softfinger.proxy.kernels.friction.laws import compute_scales, cut_to_limit
from softfinger.proxy.kernels.friction.torsion import compute_torsional_limit, find_torsional_stiffness
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import FrictionInput, LimitSurface, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.ellipsoid import limit_distance, multiplier, shrink

MAX_ENERGY_RATIO = 1e24
"""Largest ratio of the energies of the two springs at their limits; beyond it one of them is rigid."""


class Slide(NamedTuple):
    """State after the slip of a tick, and the amount of slip.

    deflection    (3,) m
    spin, twist   rad  phi before the tick, and the part of the tick's rotation that has still to be wound up
    slip          m    slip of the skin; with a limit surface the dissipated energy over the force limit
    length        m    |e|; with a limit surface the deflection that would store the same energy
    """

    deflection: Vec3
    spin: float
    twist: float
    slip: float
    length: float


@jit
def compute_room(torsion: Any, spin: float, normal_force: float) -> float:
    """Return the fraction of the static cone available to friction: 1, unless torsion and friction share one limit.

    On a limit surface it is sqrt(1 - (tau_n / tau_max)^2): 1 without torsion, 0 at the torsional limit.
    """
    if not isinstance(torsion, LimitSurface):
        return 1.0
    limit = compute_torsional_limit(torsion.law, normal_force)
    if limit <= 0.0:
        return 1.0
    share = find_torsional_stiffness(torsion.law) * spin / limit
    return sqrt(max(1.0 - share * share, 0.0))


@jit
def slide(torsion: Any, law: Any, stiffness: float, limit: float, breaking: float, inputs: FrictionInput) -> Slide:
    if isinstance(torsion, LimitSurface):
        return slide_on_limit_surface(torsion, law, stiffness, limit, breaking, inputs)
    return slide_independently(law, stiffness, limit, breaking, inputs)


@jit
def slide_independently(law: Any, stiffness: float, limit: float, breaking: float, inputs: FrictionInput) -> Slide:
    """Limit the tangential force to K |e| <= `limit`, independent of torsion."""
    deflection, slip, length = cut_to_limit(law, inputs.normal, limit / stiffness, breaking, inputs.deflection)
    return Slide(deflection, inputs.spin, inputs.twist, slip, length)


@jit
def slide_on_limit_surface(
    torsion: LimitSurface, law: Any, stiffness: float, limit: float, breaking: float, inputs: FrictionInput
) -> Slide:
    """Project (K e, k_z phi) onto (f_T / F)^2 + (tau_n / tau_max)^2 <= 1.

    The projection is the nearest point, with distance measured by the energy of the two springs: then the slip
    (de, dphi) is along the surface's normal, and dissipates the most that the surface allows.

    Source: the limit surface of Goyal, Ruina, Papadopoulos (1991) as the ellipsoid of Howe and Cutkosky (1996);
    for a god-object, Frisoli, Barbagli, Ruffaldi, Salisbury, Bergamasco (2006), who move along a limit curve.
    """
    k_z = find_torsional_stiffness(torsion.law)
    longest, widest = limit / stiffness, compute_torsional_limit(torsion.law, inputs.normal_force) / k_z
    spin = inputs.spin + inputs.twist
    if longest <= 0.0 or widest <= 0.0:
        # A degenerate surface: two separate limits, one of them zero.
        return slide_independently(law, stiffness, limit, breaking, inputs)

    d1, d2, s1, s2 = compute_scales(law, inputs.normal, inputs.deflection, breaking)
    a1, a2 = s1 * longest, s2 * longest
    y = limit_distance((vec3.dot(inputs.deflection, d1) / a1, vec3.dot(inputs.deflection, d2) / a2, spin / widest))
    deflection, slip = inputs.deflection, 0.0
    if vec3.dot(y, y) > 1.0:
        energies = longest / widest
        ratio = min(max(energies * energies * stiffness / k_z, 1.0 / MAX_ENERGY_RATIO), MAX_ENERGY_RATIO)
        weight = (1.0 / (s1 * s1), 1.0 / (s2 * s2), ratio)
        nearest = shrink(y, weight, multiplier(y, weight))
        deflection = vec3.add_scaled(vec3.scale(a1 * nearest[0], d1), a2 * nearest[1], d2)
        slip_vector, slip_angle = (
            vec3.sub(inputs.deflection, deflection),
            (spin - widest * nearest[2]) * k_z * widest / limit,
        )
        slip = sqrt(vec3.dot(slip_vector, slip_vector) + slip_angle * slip_angle)
        spin = widest * nearest[2]
    length = sqrt(vec3.dot(deflection, deflection) + k_z / stiffness * spin * spin)
    return Slide(deflection, spin, 0.0, slip, length)
