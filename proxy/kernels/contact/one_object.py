"""A tick of contact with the only object of a scene: friction first, and where it lets go the proxy follows.

`objects` are whole; `shapes` are the same objects without friction, effects and texture, for kernels that ask for no
more (`query.world.all_bare`).
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.carry import carried_direction, carry_of
from softfinger.proxy.kernels.contact.detection import Approach
from softfinger.proxy.kernels.contact.effects import Effects
from softfinger.proxy.kernels.contact.fingertip import point_under, radius_of_curvature, torque_of, velocity_at
from softfinger.proxy.kernels.contact.normal import normal_force_of
from softfinger.proxy.kernels.contact.outcome import Outcome
from softfinger.proxy.kernels.contact.resistance import ResistanceInput, resist
from softfinger.proxy.kernels.contact.rest.alone import settle_on_one
from softfinger.proxy.kernels.contact.texture import textured, with_texture_friction
from softfinger.proxy.kernels.friction.contact_patch import ContactPatch, contact_patch, torsion_under, winding_unit
from softfinger.proxy.kernels.friction.laws import turned
from softfinger.proxy.kernels.friction.stick_slip import stick_slip
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import (
    ActiveSet,
    ContactOutcome,
    ContactState,
    Finger,
    FingerState,
    FrictionInput,
    FrictionResult,
    Probe,
    Vec3,
)
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.frames import pose_values
from softfinger.proxy.record import CAUSE_NONE, SLIDING


class FrictionAlone(NamedTuple):
    """What friction makes of the candidate: its result, the contact patch, the unit of its wind-up, and the normal
    force, N, under which it was asked."""

    result: FrictionResult
    area: ContactPatch
    unit: float
    normal_force: float


class RestAlone(NamedTuple):
    """The proxy (3,) m at rest, what holds it, the same as the texture has it, the normal force there, N, and 1 where
    the search for its rest had to stop."""

    center: Vec3
    active: ActiveSet
    felt: ActiveSet
    normal_force: float
    bounded: float


@jit
def friction_alone(
    finger: Finger, objects: Any, shapes: Any, state: FingerState, probe: Probe, candidate: Approach, dt: float
) -> FrictionAlone:
    """Friction and torsion at the candidate."""
    active, last = candidate.active, state.contacts[0]
    material = with_texture_friction(objects, active, candidate.center)[0].material
    felt = textured(objects, active, probe.position)
    moves, since = carry_of(shapes[0]), 0.0 if candidate.began else dt
    against = velocity_at(finger.form, candidate.against, moves, probe, state.probe, active[0].normal, since)
    normal_force = normal_force_of(material.normal, felt[0].depth, vec3.dot(against, felt[0].normal))
    round_by = radius_of_curvature(finger.form, finger.radius, probe.orientation, active[0].normal)
    area = contact_patch(finger.patch, round_by, material.compliance, normal_force)
    unit = winding_unit(material.torsion, area, 1.0)
    result = stick_slip(
        turned(material.friction, pose_values(shapes[0].pose).orientation),
        torsion_under(material.torsion, area),
        finger.coupling,
        finger.torque_stiffness,
        FrictionInput(
            radius=finger.radius,
            resolution=finger.position_resolution,
            dt=dt,
            mode=candidate.mode,
            normal=active[0].normal,
            deflection=candidate.deflection,
            deflection_before=candidate.before,
            rolled_part=candidate.rolled_part,
            slip_speed=last.slip_speed,
            slip_deflection=last.slip_deflection,
            spin=last.spin / unit,
            twist=candidate.twist,
            spin_slip_speed=last.spin_slip_speed,
            spin_slip_angle=last.spin_slip_angle / unit,
            normal_force=normal_force,
        ),
    )
    return FrictionAlone(result, area, unit, normal_force)


@jit
def rest_alone(
    finger: Finger,
    objects: Any,
    shapes: Any,
    state: FingerState,
    probe: Probe,
    candidate: Approach,
    result: FrictionResult,
    dt: float,
) -> RestAlone:
    """Where friction lets go the proxy follows, and the normal force is that at its new place."""
    position, center, active, bounded = probe.position, candidate.center, candidate.active, 0.0
    slips = result.mode == SLIDING or result.deflection != candidate.deflection or candidate.strays
    if slips:
        center, active, bounded = settle_on_one(
            shapes[0], finger.radius, position, center, result.deflection, active[0].normal
        )
    felt, moves = textured(objects, active, position), carry_of(shapes[0])
    since = 0.0 if candidate.began else dt
    against = velocity_at(finger.form, candidate.against, moves, probe, state.probe, active[0].normal, since)
    normal_force = normal_force_of(shapes[0].material.normal, felt[0].depth, vec3.dot(against, felt[0].normal))
    return RestAlone(center, active, felt, normal_force, bounded)


@jit
def contact_state(rest: RestAlone, friction: FrictionAlone, position: Vec3, bend: Vec3) -> ContactState:
    """What the contact remembers."""
    kept, unit, active = friction.result, friction.unit, rest.active
    behind = vec3.sub(rest.center, position)
    return ContactState(
        body=0.0,
        normal=active[0].normal,
        push=active[0].depth,
        share=1.0,
        mode=kept.mode,
        deflection=vec3.sub(behind, vec3.scale(active[0].depth, active[0].normal)),
        rolled_part=vec3.reject(kept.rolled_part, active[0].normal),
        spin=kept.spin * unit,
        slip_speed=kept.slip_speed,
        slip_deflection=kept.slip_deflection,
        spin_slip_speed=kept.spin_slip_speed,
        spin_slip_angle=kept.spin_slip_angle * unit,
        bend=bend,
    )


@jit
def outcome_alone(
    finger: Finger,
    shapes: Any,
    state: FingerState,
    probe: Probe,
    candidate: Approach,
    friction: FrictionAlone,
    rest: RestAlone,
    effects: Effects,
) -> Outcome:
    """Forces of the only contact, and what becomes of it."""
    kept, normal, load = friction.result, rest.active[0].normal, rest.normal_force
    tangential, moment = vec3.reject(kept.force, normal), kept.moment
    last_bend = carried_direction(carry_of(shapes[0]), state.contacts[0].bend)
    bent = ResistanceInput(0.0, candidate.active[0].normal, 1.0, last_bend, candidate.began)
    bend, bending = resist(finger.patch, shapes, bent, probe, state.probe, friction.area)
    if friction.normal_force > load:
        # Less normal force there: both stay within their limits, the torsional one growing by up to f_N^(4/3).
        ease = load / friction.normal_force
        tangential, moment = vec3.scale(ease, tangential), ease * ease * moment
        bending = vec3.scale(ease * ease, bending)
    pressing = vec3.scale(load, rest.felt[0].normal)
    torque = torque_of(finger.form, finger.radius, probe.orientation, normal, moment, pressing, tangential)
    torque = vec3.add(torque, bending)
    reported = ContactOutcome(
        object=shapes[0].number,
        point=point_under(finger.form, finger.radius, probe.orientation, rest.center, normal),
        normal=normal,
        force=vec3.add(pressing, tangential),
        mode=kept.mode,
        spin=kept.spin,
        torque=torque,
    )
    cause = kept.cause if kept.cause != CAUSE_NONE else candidate.cause
    return Outcome(
        mode=kept.mode,
        cause=cause,
        object=reported.object,
        normal=normal,
        center=rest.center,
        shown=rest.center,
        contacts=(contact_state(rest, friction, probe.position, bend),),
        reported=(reported,),
        pressing=pressing,
        normal_force=load,
        tangential=tangential,
        effects=effects.force,
        effect_states=effects.states,
        torque=torque,
        torsion=moment,
        spin=kept.spin,
        radius=friction.area.radius,
        rolled=state.rolled + candidate.theta,
        stuck=0.0,
        budget=max(rest.bounded, candidate.bounded, effects.unknown),
    )
