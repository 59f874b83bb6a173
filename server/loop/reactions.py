"""Work of contacts with moving bodies: the passivity observer counts only the relative motion.

A hand that lowers a body receives the body's weight times the displacement. This energy comes from the body, not from
the contact. The contact has generated the energy that the hand received, minus the energy that the bodies gave up. A
contact's wrench on the hand is constant during a tick, so the bodies' part is that wrench times their motion at the
fingertip's centre.
"""

from typing import Any, Final, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import map_each
from softfinger.proxy.kernels.model import Bodies, Contact, ContactOutcome, FingerState, Pose, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.rotations import log, relative, rotate
from softfinger.proxy.kernels.query.bodies import POSITION, has_fault, read_body_pose
from softfinger.server.loop.guard import GuardState
from softfinger.server.loop.passivity import Energy


class Reaction(NamedTuple):
    """Wrench of a contact between a hand and a body, constant from one tick to the next.

    body    index of the body, 0 for a fixed object
    force   (3,)  N    on the hand, as far as the hand receives it
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


def make_no_reactions(bodies: Any, finger: FingerState) -> Any:
    """Return the reactions before the first tick, one for each possible contact; None in a scene without bodies."""
    return None if bodies is None else (NO_REACTION,) * len(finger.contacts)


@jit
def compute_received_share(requested: Vec3, received: Vec3) -> float:
    """Return the fraction of the requested force or torque of the contacts that the hand receives, 0 to 1."""
    square = vec3.dot(requested, requested)
    return min(max(vec3.dot(requested, received) / square, 0.0), 1.0) if square > 0.0 else 0.0


@jit
def collect_reactions(
    passivity: Any, bodies: Any, before: Any, contact: Contact, applied: GuardState, center: Vec3
) -> Any:
    """Return the wrenches of contacts until the next tick, a tuple of Reaction; `before` unchanged without an observer.

    applied  wrench on the fingertip, about its `center` (3,) m, after the guard
    """
    if passivity is None or bodies is None:
        return before
    force_share = compute_received_share(contact.force, applied.force)
    torque_share = compute_received_share(contact.torque, applied.torque)
    return map_each(make_reaction, (contact.contacts,), bodies, force_share, torque_share, center)


@jit
def make_reaction(
    outcome: ContactOutcome, bodies: Bodies, force_share: float, torque_share: float, center: Vec3
) -> Reaction:
    body = bodies.attached[int(outcome.object)] if outcome.object >= 0.0 else 0.0
    force, torque = vec3.scale(force_share, outcome.force), vec3.scale(torque_share, outcome.torque)
    return Reaction(body, force, torque, center, read_body_pose(bodies.block, body, POSITION))


@jit
def compute_relative_energy(passivity: Any, bodies: Any, energy: Energy, last_reactions: Any) -> Energy:
    """Return the energy after the last tick, plus the work of contacts over the motion of the bodies since then.

    last_reactions  Reactions, or None in a scene without bodies
    """
    if passivity is None or bodies is None:
        return energy
    work = 0.0
    if not has_fault(bodies):
        for reaction in last_reactions:
            now, before = read_body_pose(bodies.block, reaction.body, POSITION), reaction.pose
            turned = relative(now.orientation, before.orientation)
            target = vec3.add(now.position, rotate(turned, vec3.sub(reaction.center, before.position)))
            work += vec3.dot(reaction.force, vec3.sub(target, reaction.center)) + vec3.dot(reaction.torque, log(turned))
    return Energy(energy.work + work, energy.damping)
