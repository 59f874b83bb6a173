"""End of a tick: the state for the next tick, and the report of this one.

Contacts with one object and with several objects both result in an `Outcome`, from which `step` computes the two.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.approach import STUCK_TICKS
from softfinger.proxy.kernels.contact.fingertip import point_on, point_under
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import first_of
from softfinger.proxy.kernels.model import NO_CONTACT, NO_OUTCOME, Contact, Finger, FingerState, Probe, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.record import CAUSE_NONE, CAUSE_RELEASE, CAUSE_RESTART, FREE


class Outcome(NamedTuple):
    """Contact at the end of a tick.

    mode, cause         of the first contact, and of its change in this tick
    object              index in the scene file of the object of the first contact, -1 for none
    normal              (3,)      of that object
    center              (3,) m    proxy
    contacts            ContactState of each contact
    reported            ContactOutcome of each contact
    pressing            (3,) N    sum of the normal forces
    normal_force        N         its magnitude
    tangential          (3,) N    sum of the friction forces
    effects             (3,) N    force of the effects; `effect_states` are their states for the next tick
    torque              (3,) N m  about the fingertip's centre
    torsion, spin                 moment about the normal, N m, and torsional wind-up, rad, of the first contact
    radius              m         of its contact patch
    rolled              rad       roll angle since touch
    stuck                         consecutive ticks without a rest position
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
def end_contact_tick(finger: Finger, probe: Probe, outcome: Outcome) -> tuple[FingerState, Contact]:
    """Return the FingerState after a tick in contact, and its Contact, with the wrench on the hand."""
    state = FingerState(
        started=1.0,
        probe=probe,
        mode=outcome.mode,
        center=outcome.center,
        contacts=outcome.contacts,
        rolled=outcome.rolled,
        stuck=outcome.stuck,
        effects=outcome.effect_states,
    )
    # On a curved surface, a proxy displaced by friction is below the tangent plane of its rest position: the depth is
    # that of the rest position. It is 0 in the tick in which a slip moves the proxy to where the probe is outside.
    depth = max(vec3.dot(vec3.sub(outcome.center, probe.position), outcome.normal), 0.0)
    to_fingertip, normal = rotations.conjugate(probe.orientation), outcome.normal
    inward = rotations.rotate(to_fingertip, normal)
    contact = Contact(
        mode=outcome.mode,
        object=outcome.object,
        cause=outcome.cause,
        velocity=probe.velocity,
        center=outcome.center,
        penetration=depth,
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
    return state, contact


@jit
def make_free_state(state: FingerState, probe: Probe, effect_states: Any, known: bool) -> FingerState:
    """Return the state in free space; if a touch of the first pose is not `known`, the next pose is the first again."""
    return FingerState(
        started=1.0 if known else state.started,
        probe=probe,
        mode=float(FREE),
        center=probe.position,
        contacts=first_of(state.contacts, NO_CONTACT, NO_CONTACT),
        rolled=0.0,
        stuck=0.0,
        effects=effect_states,
    )


@jit
def make_free_contact(state: FingerState, probe: Probe, force: Vec3, budget: float) -> Contact:
    """Return the result in free space; the end of a contact is a release, or a restart if the proxy was stuck."""
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
        contacts=first_of(state.contacts, NO_OUTCOME, NO_OUTCOME),
        budget=budget,
    )
