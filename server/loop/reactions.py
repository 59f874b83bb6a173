"""Work of contacts with bodies that move: what the passivity observer counts is the relative motion.

A hand that lowers a body is given the body's weight times the way: energy of the body, not of the contact. The contact
has made what the hand is given less what the bodies gave. In a tick a contact's wrench on the hand is held, so the
bodies' part of it is that wrench times their motion since, at the fingertip's centre.
"""

from typing import Any, Final, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.jit.tuples import map_each, same_for
from softfinger.proxy.kernels.model import Bodies, Contact, ContactOutcome, FingerState, Pose, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.rotations import log, relative, rotate
from softfinger.proxy.kernels.query.bodies import faulty, pose_of_body
from softfinger.server.loop.guard import Guarded
from softfinger.server.loop.passivity import Energy, Passivity


class Reaction(NamedTuple):
    """A contact that holds a wrench between a hand and a body from one tick to the next.

    body    number of the body, 0 for what does not move
    force   (3,)  N    on the hand, as far as the hand is given it
    torque  (3,)  N m  the same, about `center`
    center  (3,)  m    of the fingertip
    pose    Pose       of the body
    """

    body: float
    force: Vec3
    torque: Vec3
    center: Vec3
    pose: Pose


_ZERO: Final = (0.0, 0.0, 0.0)
NO_REACTION: Final = Reaction(0.0, _ZERO, _ZERO, _ZERO, Pose(_ZERO, (1.0, 0.0, 0.0, 0.0)))


def no_reactions(bodies: Any, finger: FingerState) -> Any:
    """Before the first tick: one for each contact that there may be; None in a scene without bodies."""
    return None if bodies is None else same_for(finger.contacts, NO_REACTION)


@jit
def share_given(asked: Vec3, given: Vec3) -> float:
    """The part of what contacts ask for that the hand is given, 0 to 1."""
    square = vec3.dot(asked, asked)
    return min(max(vec3.dot(asked, given) / square, 0.0), 1.0) if square > 0.0 else 0.0


@by_type
def reactions_of(passivity: Any, bodies: Any, before: Any, contact: Contact, given: Guarded, center: Vec3) -> Any:
    """What contacts hold until the next tick, a tuple of Reaction; those of `before` where nobody observes.

    given   wrench on the fingertip, about its `center` (3,) m, behind the guard
    """


@reactions_of.of(None)
def unobserved(passivity: None, bodies: Any, before: Any, contact: Contact, given: Guarded, center: Vec3) -> Any:
    return before


@reactions_of.of(Passivity)
def observed_reactions(
    passivity: Passivity, bodies: Any, before: Any, contact: Contact, given: Guarded, center: Vec3
) -> Any:
    return reactions_on(bodies, contact, given, center)


@by_type
def reactions_on(bodies: Any, contact: Contact, given: Guarded, center: Vec3) -> Any:
    """Reactions, or None in a scene without bodies."""


@reactions_on.of(None)
def no_reactions_on(bodies: None, contact: Contact, given: Guarded, center: Vec3) -> None:
    return None


@reactions_on.of(Bodies)
def reactions_on_bodies(bodies: Bodies, contact: Contact, given: Guarded, center: Vec3) -> Any:
    of_force, of_torque = share_given(contact.force, given.force), share_given(contact.torque, given.torque)
    return map_each(reaction, (contact.contacts,), bodies, of_force, of_torque, center)


@jit
def reaction(outcome: ContactOutcome, bodies: Bodies, of_force: float, of_torque: float, center: Vec3) -> Reaction:
    body = bodies.riders[int(outcome.object)] if outcome.object >= 0.0 else 0.0
    force, torque = vec3.scale(of_force, outcome.force), vec3.scale(of_torque, outcome.torque)
    return Reaction(body, force, torque, center, pose_of_body(bodies.block, body))


@by_type
def relative_energy(passivity: Any, bodies: Any, energy: Energy, held: Any) -> Any:
    """The energy of the last tick, with what bodies have given since by their motion; `held` are Reactions, or None."""


@relative_energy.of(None)
def not_observed(passivity: None, bodies: Any, energy: Energy, held: Any) -> Energy:
    return energy


@relative_energy.of(Passivity)
def with_what_bodies_gave(passivity: Passivity, bodies: Any, energy: Energy, held: Any) -> Energy:
    return Energy(energy.work + work_of_bodies(bodies, held), energy.damping)


@by_type
def work_of_bodies(bodies: Any, held: Any) -> Any:
    """Work (J) that the wrenches of Reactions do over the motion of their bodies since."""


@work_of_bodies.of(None)
def work_of_none(bodies: None, held: Any) -> float:
    return 0.0


@work_of_bodies.of(Bodies)
def work_of_all(bodies: Bodies, held: Any) -> float:
    work = 0.0
    if not faulty(bodies):
        for each in held:
            now, was = pose_of_body(bodies.block, each.body), each.pose
            turned = relative(now.orientation, was.orientation)
            there = vec3.add(now.position, rotate(turned, vec3.sub(each.center, was.position)))
            work += vec3.dot(each.force, vec3.sub(there, each.center)) + vec3.dot(each.torque, log(turned))
    return work
