"""Forces on the hand in addition to the contact force: fields of the workspace, and effects of objects.

    apply_effects(effects, states, situation) -> force, states     all effects of the workspace or of one object
    compute_effect(effect, state, situation)    -> force, state      one effect
    compute_share(region, situation)          -> 0 to 1            share of an effect at this position, in this tick
    start_states(effects)                     -> states            before the first tick; Python only

An effect without memory has the state None. Without effects the tuple is empty, and no code is compiled. Finite input
gives finite force at any position and velocity: products are clamped to FORCE_CEILING_N.
"""

from math import pi, sin
from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.jit.tuples import fold_each, map_each, unzip
from softfinger.proxy.kernels.model import (
    Anchor,
    BoxBoundary,
    ConstantForce,
    Magnet,
    NormalVibration,
    Phase,
    SphereBoundary,
    SphereRegion,
    Spring,
    StickSlip,
    TouchCondition,
    Vec3,
    Vibration,
    Viscosity,
)
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.frames import into, out_of
from softfinger.proxy.kernels.numerics.scalars import clamp, fraction

FORCE_CEILING_N = 1e6
"""Limit that only keeps products of absurd numbers finite; the guard limits the force on the hand."""
NO_FORCE: Vec3 = (-0.0, -0.0, -0.0)
"""Negative zeros: adding them changes no bit of any number, so the compiler leaves the addition out."""
NO_LENGTH_M = 1e-100
"""Shorter vectors count as zero: the squares of their components underflow."""


class Situation(NamedTuple):
    """Inputs of an effect in one tick; world frame.

    position  (3,)  m    probe
    velocity  (3,)  m/s  probe, filtered; for an object's effects relative to the object at the probe
    dt              s    since the last tick
    touched              1 in contact (for an object's effects: with this object), otherwise 0
    gap             m    from the fingertip's surface to that of this object; ignored while touched, 0 for the workspace
    normal    (3,)       unit normal of the contact, or of this object's surface point nearest to the probe
    carrier              Pose of an object that can move, None for a fixed object and for the workspace
    """

    position: Vec3
    velocity: Vec3
    dt: float
    touched: float
    gap: float
    normal: Vec3
    carrier: Any


@by_type
def compute_effect(effect: Any, state: Any, situation: Situation) -> Any: ...


# --- regions -------------------------------------------------------------------------------------


@jit
def share_at(depth: float, edge: float) -> float:
    """Return the share of an effect at `depth` (m) inside its region; it rises from 0 to 1 over `edge` (m)."""
    if depth <= 0.0:
        return 0.0
    if depth < edge:
        return depth / edge
    return 1.0


@jit
def compute_share(region: Any, situation: Situation) -> float:
    if region is None:
        return 1.0
    if isinstance(region, TouchCondition):
        return 0.0 if situation.touched == 0.0 else region.share
    away = vec3.sub(situation.position, region.center)
    if isinstance(region, SphereRegion):
        return share_at(region.radius - vec3.norm(away), region.edge)
    half = region.half_extents
    depth = min(half[0] - abs(away[0]), half[1] - abs(away[1]), half[2] - abs(away[2]))
    return share_at(depth, region.edge)


# --- bounds --------------------------------------------------------------------------------------


@jit
def scale_clamped(s: float, v: Vec3) -> Vec3:
    """Return s v, each component clamped to FORCE_CEILING_N."""
    return (
        clamp(s * v[0], FORCE_CEILING_N),
        clamp(s * v[1], FORCE_CEILING_N),
        clamp(s * v[2], FORCE_CEILING_N),
    )


# --- fields --------------------------------------------------------------------------------------


@compute_effect.of(Viscosity)
def apply_viscosity(effect: Viscosity, state: None, situation: Situation) -> tuple[Vec3, None]:
    """Return -B v, scaled by the region's share: it dissipates energy everywhere, also at the edge of the region."""
    return scale_clamped(-compute_share(effect.region, situation) * effect.damping, situation.velocity), None


@compute_effect.of(ConstantForce)
def apply_constant_force(effect: ConstantForce, state: None, situation: Situation) -> tuple[Vec3, None]:
    return scale_clamped(compute_share(effect.region, situation), effect.force), None


@compute_effect.of(Spring)
def apply_spring(effect: Spring, state: None, situation: Situation) -> tuple[Vec3, None]:
    """Return the force K (d - rest_length) towards the anchor, negative if the spring is shorter, up to `force_max`."""
    towards = vec3.sub(effect.anchor, situation.position)
    length = vec3.norm(towards)
    if length < NO_LENGTH_M:
        return (0.0, 0.0, 0.0), None
    pull = clamp(effect.stiffness * (length - effect.rest_length), effect.force_max)
    return scale_clamped(compute_share(effect.region, situation) * pull / length, towards), None


@jit
def compute_wall_force(effect: Any, outward: Vec3, situation: Situation) -> Vec3:
    """Return the force of a spring-damper at a boundary.

    outward  (3,)  m  displacement beyond the boundary, zero inside

    As in a contact, damping can cancel or double the spring's force, but not reverse it: the force is zero at the
    boundary and never points outward.
    """
    depth = vec3.norm(outward)
    if depth < NO_LENGTH_M:
        return (0.0, 0.0, 0.0)
    inward = vec3.scale(-1.0 / depth, outward)
    elastic = min(effect.stiffness * depth, effect.force_max)
    total = elastic - clamp(effect.damping * vec3.dot(situation.velocity, inward), FORCE_CEILING_N)
    push = min(max(total, 0.0), 2.0 * elastic, effect.force_max)
    return scale_clamped(push, inward)


@compute_effect.of(BoxBoundary)
def apply_box_boundary(effect: BoxBoundary, state: None, situation: Situation) -> tuple[Vec3, None]:
    away = vec3.sub(situation.position, effect.center)
    half = effect.half_extents
    outward = (away[0] - clamp(away[0], half[0]), away[1] - clamp(away[1], half[1]), away[2] - clamp(away[2], half[2]))
    return compute_wall_force(effect, outward, situation), None


@compute_effect.of(SphereBoundary)
def apply_sphere_boundary(effect: SphereBoundary, state: None, situation: Situation) -> tuple[Vec3, None]:
    away = vec3.sub(situation.position, effect.center)
    distance = vec3.norm(away)
    if distance <= effect.radius:
        return (0.0, 0.0, 0.0), None
    return compute_wall_force(effect, vec3.scale(1.0 - effect.radius / distance, away), situation), None


# --- vibration -----------------------------------------------------------------------------------


@jit
def oscillate(effect: Any, share: float, state: Phase, dt: float) -> tuple[float, Phase]:
    """Return the force (N) of a vibration in this tick, and the phase of the next; a share of 0 resets the phase.

    The phase is accumulated tick by tick, not computed from the time, so that a change of the frequency causes no jump
    of the force.
    """
    if share == 0.0:
        return 0.0, Phase(0.0)
    force = share * effect.amplitude * sin(2.0 * pi * state.turns)
    return force, Phase(fraction(state.turns + fraction(effect.frequency * dt)))


@compute_effect.of(Vibration)
def apply_vibration(effect: Vibration, state: Phase, situation: Situation) -> tuple[Vec3, Phase]:
    force, after = oscillate(effect, compute_share(effect.region, situation), state, situation.dt)
    return scale_clamped(force, effect.direction), after


@compute_effect.of(NormalVibration)
def apply_normal_vibration(effect: NormalVibration, state: Phase, situation: Situation) -> tuple[Vec3, Phase]:
    force, after = oscillate(effect, situation.touched, state, situation.dt)
    return scale_clamped(force, situation.normal), after


# --- objects -------------------------------------------------------------------------------------


@compute_effect.of(Magnet)
def apply_magnet(effect: Magnet, state: None, situation: Situation) -> tuple[Vec3, None]:
    """Return F (1 - gap / range)^exponent towards the nearest point of the surface.

    Full strength during contact: the contact's spring then balances it, without a step of the force at touchdown. The
    force depends on the distance only, so it is conservative.
    """
    gap = 0.0 if situation.touched != 0.0 else max(situation.gap, 0.0)
    if gap >= effect.range:
        return (0.0, 0.0, 0.0), None
    return scale_clamped(-effect.force * (1.0 - gap / effect.range) ** effect.exponent, situation.normal), None


@compute_effect.of(StickSlip)
def apply_stick_slip(effect: StickSlip, state: Anchor, situation: Situation) -> tuple[Vec3, Anchor]:
    """Return the force of a spring from the probe to an anchor on the object, along the surface.

    When the force would exceed `force_max`, the anchor jumps to the probe and the force is zero. Each jump loses the
    spring's energy, so the texture dissipates F^2 / 2K per ridge and never adds energy. As in CHAI3D, but along the
    surface only: the contact handles the component along the normal.
    """
    zero = (0.0, 0.0, 0.0)
    if situation.touched == 0.0:
        return zero, Anchor(zero, 0.0)
    anchor = Anchor(into(situation.carrier, situation.position), 1.0)
    if state.is_set == 0.0:
        return zero, anchor
    stretch = vec3.sub(out_of(situation.carrier, state.point), situation.position)
    pull = vec3.scale(effect.stiffness, vec3.reject(stretch, situation.normal))
    if vec3.norm(pull) <= effect.force_max:
        return pull, state
    return zero, anchor


# --- all effects ---------------------------------------------------------------------------------


@jit
def apply_effects(effects: Any, states: Any, situation: Situation) -> Any:
    """Return the total force (3,) N of a tuple of effects, and their states after this tick."""
    forces, after = unzip(map_each(compute_effect, (effects, states), situation))
    return fold_each(vec3.add, forces, NO_FORCE), after


def start_states(effects: tuple[Any, ...]) -> tuple[Any, ...]:
    """Return the states of effects before the first tick."""
    starts = {StickSlip: Anchor((0.0, 0.0, 0.0), 0.0), Vibration: Phase(0.0), NormalVibration: Phase(0.0)}
    return tuple(starts.get(type(effect)) for effect in effects)
