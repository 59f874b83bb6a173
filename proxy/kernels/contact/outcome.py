"""End of a tick: the state for the next tick, and the report of this one.

Contacts with one object and with several objects both result in an `Outcome`, from which `step` computes the two.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.approach import STUCK_TICKS, Approach, count_stuck_ticks
from softfinger.proxy.kernels.contact.effects import Effects
from softfinger.proxy.kernels.contact.fingertip import find_finger_point
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import first_of
from softfinger.proxy.kernels.model import NO_CONTACT, NO_OUTCOME, Contact, Finger, FingerState, Probe, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.record import CAUSE_NONE, CAUSE_RELEASE, CAUSE_RESTART, CAUSE_TOUCH, FREE, UNSEARCHED


class Outcome(NamedTuple):
    """Contact at the end of a tick.

    center          (3,) m    proxy
    contacts                  ContactState of each contact
    outcomes                  ContactOutcome of each contact
    pressing        (3,) N    sum of the normal forces
    normal_force    N         its magnitude
    tangential      (3,) N    sum of the friction forces
    trailing_force  (3,) N    additional force of a late proxy, see `compute_trailing_force`
    torque          (3,) N m  about the fingertip's centre
    torsion         N m       moment about the normal of the first contact
    radius          m         of its contact patch
    is_late                   True if the proxy is not yet at rest
    budget                    see `Contact.budget`
    """

    center: Vec3
    contacts: Any
    outcomes: Any
    pressing: Vec3
    normal_force: float
    tangential: Vec3
    trailing_force: Vec3
    torque: Vec3
    torsion: float
    radius: float
    is_late: bool
    budget: float


@jit
def end_contact_tick(
    finger: Finger, probe: Probe, approach: Approach, cause: float, outcome: Outcome, effects: Effects
) -> tuple[FingerState, Contact]:
    """Return the FingerState after a tick in contact, and its Contact, with the wrench on the hand.

    cause  of the change of mode by friction
    """
    center, first, budget = outcome.center, outcome.outcomes[0], outcome.budget
    stuck = count_stuck_ticks(approach, center) if outcome.is_late else 0.0
    if approach.is_new and cause == CAUSE_NONE:
        cause = float(CAUSE_TOUCH)
    if effects.unknown != 0.0:
        budget = float(UNSEARCHED)
    state = FingerState(
        started=1.0,
        probe=probe,
        mode=outcome.contacts[0].mode,
        center=center,
        contacts=outcome.contacts,
        rolled=approach.rolled,
        stuck_ticks=stuck,
        effects=effects.states,
    )
    # On a curved surface, a proxy displaced by friction is below the tangent plane of its rest position: the depth is
    # that of the rest position. It is 0 in the tick in which a slip moves the proxy to where the probe is outside.
    depth = max(vec3.dot(vec3.sub(center, probe.position), first.normal), 0.0)
    to_fingertip = rotations.conjugate(probe.orientation)
    inward = rotations.rotate(to_fingertip, first.normal)
    contact = Contact(
        mode=state.mode,
        object=first.object,
        cause=cause,
        velocity=probe.velocity,
        center=center,
        penetration=depth,
        point=first.point,
        normal=first.normal,
        finger_point=find_finger_point(finger, inward),
        rolled=approach.rolled,
        spin=first.spin,
        normal_force=outcome.normal_force,
        tangential_force=vec3.norm(outcome.tangential),
        force=vec3.add(vec3.add(outcome.pressing, outcome.tangential), vec3.add(effects.force, outcome.trailing_force)),
        torque=outcome.torque,
        torsion=outcome.torsion,
        patch_radius=outcome.radius,
        patch_normal=inward,
        patch_stretch=rotations.rotate(to_fingertip, vec3.reject(outcome.contacts[0].deflection, first.normal)),
        contacts=outcome.outcomes,
        budget=budget,
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
        stuck_ticks=0.0,
        effects=effect_states,
    )


@jit
def make_free_contact(state: FingerState, probe: Probe, force: Vec3, budget: float) -> Contact:
    """Return the result in free space; the end of a contact is a release, or a restart if the proxy was stuck."""
    zero, cause = (0.0, 0.0, 0.0), float(CAUSE_NONE)
    if state.mode != FREE:
        cause = float(CAUSE_RESTART) if state.stuck_ticks >= STUCK_TICKS else float(CAUSE_RELEASE)
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
