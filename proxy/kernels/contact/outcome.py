"""The end of a tick: what the contact state keeps for the next one, and what is reported of this one.

A contact with one object and a contact with several end in the same `Outcome`, and from there go the same way.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.detection import STUCK_TICKS
from softfinger.proxy.kernels.contact.fingertip import point_on, point_under
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import same_for
from softfinger.proxy.kernels.model import (
    NO_CONTACT,
    NO_OUTCOME,
    Contact,
    Finger,
    FingerState,
    Probe,
    Vec3,
)
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.record import CAUSE_NONE, CAUSE_RELEASE, CAUSE_RESTART, FREE


class Outcome(NamedTuple):
    """A contact at the end of a tick.

    mode, cause         of the first contact, and of its change in this tick
    object              number in the scene file of what bears the first contact, -1 for none
    normal              (3,)      of that object
    center              (3,) m    proxy
    contacts            ContactState of each contact
    reported            ContactOutcome of each contact
    pressing            (3,) N    sum of the normal forces
    normal_force        N         its magnitude
    tangential          (3,) N    sum of the friction forces
    effects             (3,) N    force of the effects; `effect_states` is what they remember
    torque              (3,) N m  about the fingertip's centre
    torsion, spin                 moment about the normal, N m, and torsional wind-up, rad, of the first contact
    radius              m         of its contact patch
    rolled              rad       roll angle since touch
    stuck                         ticks in a row without rest
    budget                        see `Contact.budget`
    """

    mode: float
    cause: float
    object: float
    normal: Vec3
    center: Vec3
    contacts: Any
    reported: Any
    pressing: Vec3
    normal_force: float
    tangential: Vec3
    effects: Vec3
    effect_states: Any
    torque: Vec3
    torsion: float
    spin: float
    radius: float
    rolled: float
    stuck: float
    budget: float


@jit
def remember(probe: Probe, outcome: Outcome) -> FingerState:
    """What the next tick needs of this one."""
    return FingerState(
        started=1.0,
        probe=probe,
        mode=outcome.mode,
        center=outcome.center,
        contacts=outcome.contacts,
        rolled=outcome.rolled,
        stuck=outcome.stuck,
        effects=outcome.effect_states,
    )


@jit
def report(finger: Finger, probe: Probe, outcome: Outcome) -> Contact:
    """What telemetry says of this tick, and the wrench."""
    to_fingertip, normal = rotations.conjugate(probe.orientation), outcome.normal
    inward = rotations.rotate(to_fingertip, normal)
    return Contact(
        mode=outcome.mode,
        object=outcome.object,
        cause=outcome.cause,
        velocity=probe.velocity,
        center=outcome.center,
        penetration=vec3.dot(vec3.sub(outcome.center, probe.position), normal),
        point=point_under(finger.form, finger.radius, probe.orientation, outcome.center, normal),
        normal=normal,
        finger_point=point_on(finger.form, finger.radius, inward),
        rolled=outcome.rolled,
        spin=outcome.spin,
        normal_force=outcome.normal_force,
        tangential_force=vec3.norm(outcome.tangential),
        force=vec3.add(vec3.add(outcome.pressing, outcome.tangential), outcome.effects),
        torque=outcome.torque,
        torsion=outcome.torsion,
        patch_radius=outcome.radius,
        patch_normal=inward,
        patch_stretch=rotations.rotate(to_fingertip, vec3.reject(outcome.contacts[0].deflection, normal)),
        contacts=outcome.reported,
        budget=outcome.budget,
    )


@jit
def remember_free(state: FingerState, probe: Probe, effect_states: Any, known: bool) -> FingerState:
    """Free space; where it is not `known` whether a first pose touches, the next tick's pose is the first again."""
    return FingerState(
        started=1.0 if known else state.started,
        probe=probe,
        mode=float(FREE),
        center=probe.position,
        contacts=same_for(state.contacts, NO_CONTACT),
        rolled=0.0,
        stuck=0.0,
        effects=effect_states,
    )


@jit
def report_free(state: FingerState, probe: Probe, force: Vec3, budget: float) -> Contact:
    """Free space; leaving a contact is a release, or a new start where the proxy was stuck in it."""
    zero, cause = (0.0, 0.0, 0.0), float(CAUSE_NONE)
    if state.mode != FREE:
        cause = float(CAUSE_RESTART) if state.stuck >= STUCK_TICKS else float(CAUSE_RELEASE)
    return Contact(
        mode=float(FREE),
        object=-1.0,
        cause=cause,
        velocity=probe.velocity,
        center=probe.position,
        penetration=0.0,
        point=zero,
        normal=zero,
        finger_point=zero,
        rolled=0.0,
        spin=0.0,
        normal_force=0.0,
        tangential_force=0.0,
        force=force,
        torque=zero,
        torsion=0.0,
        patch_radius=0.0,
        patch_normal=zero,
        patch_stretch=zero,
        contacts=same_for(state.contacts, NO_OUTCOME),
        budget=budget,
    )
