"""Continuation of the only contact of the last tick: moved with its object, and rolled."""

from typing import Any

from softfinger.proxy.kernels.contact.approach import NO_PREDICTION, Approach, has_ended, release_contacts
from softfinger.proxy.kernels.contact.contact_friction import Prediction
from softfinger.proxy.kernels.contact.detection import detect_contact
from softfinger.proxy.kernels.contact.rest.active_set import make_single_constraint
from softfinger.proxy.kernels.contact.rest.facets import roll_over_edge
from softfinger.proxy.kernels.contact.rolling import OffsetPoint, Roll
from softfinger.proxy.kernels.contact.rolling.on_objects import can_follow, roll_on
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import first_of, replace
from softfinger.proxy.kernels.model import Finger, FingerState, Probe, Quaternion, Scene, Vec3
from softfinger.proxy.kernels.model.vectors import ZERO
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.query.carry import compute_relative_rotation, make_carry, move_point, turn_direction
from softfinger.proxy.kernels.query.container import find_object
from softfinger.proxy.kernels.query.objects import does_slide_round_hollow
from softfinger.proxy.kernels.shapes import is_hollow, transport
from softfinger.proxy.kernels.shapes.budget import BUDGET
from softfinger.proxy.record import FREE


@jit
def adjust_roll_in_hollow(
    method: Any, body: Any, radius: float, position: Vec3, start: OffsetPoint, turn: Quaternion, rolled: Roll
) -> tuple[Roll, Vec3, bool]:
    """Return the effect of a roll from `start` on the coupling in a hollow; elsewhere it is `rolled`.

    returns  Roll, the part of it (3,) m that the centre has not followed, and True if the centre followed none of it
    """
    center, normal = start
    unfollowed = (-0.0, -0.0, -0.0)
    lacks_roll = not can_follow(body, radius, start, rolled.center)
    if method is None:
        return Roll(center, normal, ZERO, 0.0, rolled.spin, True) if lacks_roll else rolled, unfollowed, lacks_roll
    slides = does_slide_round_hollow(body, radius, center, normal, rolled.theta)
    if lacks_roll or slides or not rolled.is_complete:
        # The roll winds up the coupling in the tangent plane, and friction decides where the centre moves.
        lacks_roll = True
        path, spin = rotations.roll_unit_ball(turn, normal), rotations.twist(turn, normal)
        unfollowed = vec3.scale(radius, path)
        rolled = Roll(center, normal, unfollowed, vec3.norm(path), spin, rolled.is_complete)
    elif is_hollow(body.shape):
        # Rotating the normal makes a part of the depth tangential: u (1 + depth / (R - r)) in a round hollow.
        tangential_before = vec3.reject(vec3.sub(center, position), normal)
        tangential_after = vec3.reject(vec3.sub(rolled.center, position), rolled.normal)
        motion = vec3.sub(tangential_after, transport(body.shape, tangential_before, normal, rolled.normal))
        rolled = Roll(rolled.center, rolled.normal, motion, rolled.theta, rolled.spin, True)
    return rolled, unfollowed, lacks_roll


@jit
def continue_contact(
    scene: Scene, finger: Finger, objects: Any, index: float, state: FingerState, probe: Probe, dt: float
) -> Approach:
    """Move the only contact with its object, and roll it by the fingertip's rotation relative to the object."""
    radius, position, last, body = finger.radius, probe.position, state.contacts[0], find_object(objects, index)
    carry = make_carry(body)
    old_normal, carried_center = turn_direction(carry, last.normal), move_point(carry, state.center)
    turn = compute_relative_rotation(carry, rotations.relative(probe.orientation, state.probe.orientation))
    rolled = roll_on(scene.rolling, body, radius, carried_center, old_normal, turn)
    start = OffsetPoint(carried_center, old_normal)
    is_complete = rolled.is_complete
    rolled, unfollowed, lacks_roll = adjust_roll_in_hollow(scene.rolling, body, radius, position, start, turn, rolled)
    rolled, index = roll_over_edge(objects, scene.rolling, index, radius, start, rolled, turn)
    center, normal = rolled.center, rolled.normal
    rolled_part = transport(body.shape, turn_direction(carry, last.rolled_part), old_normal, normal)
    old_deflection = transport(body.shape, turn_direction(carry, last.deflection), old_normal, normal)
    to_proxy = vec3.sub(center, position)
    depth = max(vec3.dot(to_proxy, normal), 0.0)
    contact = replace(
        last, "object_index", index, "normal", normal, "push", depth, "share", 1.0, "mode", state.mode,
        "deflection", old_deflection, "rolled_part", vec3.add(rolled_part, rolled.motion),
        "bend", turn_direction(carry, last.bend),
    )  # fmt: skip
    deflection = vec3.add(vec3.sub(to_proxy, vec3.scale(depth, normal)), unfollowed)
    return Approach(
        start=state.center,
        clear_center=carried_center,
        center=center,
        active=make_single_constraint(index, normal, depth),
        predicted=first_of(state.contacts, Prediction(contact, deflection, rolled.spin, False), NO_PREDICTION),
        rolled=state.rolled + rolled.theta,
        center_lacks_roll=lacks_roll,
        is_single=True,
        is_new=False,
        budget_exhausted=0.0 if is_complete else 1.0,
        budget=BUDGET,
        stuck_ticks=state.stuck_ticks,
    )


@jit
def detect_or_continue(
    scene: Scene, finger: Finger, objects: Any, state: FingerState, probe: Probe, dt: float
) -> tuple[FingerState, Approach]:
    """Continue the contact with the only object; if it is released, detect a new one in the same tick.

    The returned state does not include a released contact.
    """
    if state.mode != FREE:
        approach = continue_contact(scene, finger, objects, 0.0, state, probe, dt)
        if not has_ended(approach.active):
            return state, approach
    state = release_contacts(state)
    return state, detect_contact(finger, objects, state, probe)
