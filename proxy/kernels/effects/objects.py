"""Effects of all objects, each evaluated with the gap, normal and velocity relative to its object."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.effects.forces import Situation, apply_effects
from softfinger.proxy.kernels.jit.dispatch import by_count
from softfinger.proxy.kernels.model import Constraint, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.query.elements import element
from softfinger.proxy.kernels.query.motion import carried_along, moving_pose
from softfinger.proxy.kernels.query.objects import closest_or_bound_on


class Touched(NamedTuple):
    """Active constraints of the proxy, and the previous probe position.

    one, two, three          constraints; their `body` is the scene index of the object, -1 for none
    before           (3,) m  probe position at the last tick
    """

    one: Constraint
    two: Constraint
    three: Constraint
    before: Vec3


@by_count
def apply_objects_effects(objects: Any, states: Any, radius: float, touched: Touched, contact: Situation) -> Any:
    """Return the total force (3,) N of the effects of all objects, their states, and a flag.

    The flag is 1 if the gap of an object may be too large because the search for its nearest point did not finish,
    otherwise 0.
    """


@apply_objects_effects.of(1)
def effects_of_one(objects: Any, states: Any, radius: float, touched: Touched, contact: Situation) -> Any:
    body = objects[0]
    force, state, unsearched = effects_of(element(body, 0.0).effects, body, states[0], radius, touched, contact)
    return force, (state,), unsearched


@apply_objects_effects.of(2)
def effects_of_several(objects: Any, states: Any, radius: float, touched: Touched, contact: Situation) -> Any:
    body = objects[0]
    force, state, unsearched = effects_of(element(body, 0.0).effects, body, states[0], radius, touched, contact)
    others, rest, more = apply_objects_effects(objects[1:], states[1:], radius, touched, contact)
    states = (state,) + rest  # noqa: RUF005  # see query.world.poses_of_several_at
    return vec3.add(force, others), states, max(unsearched, more)


@by_count
def effects_of(effects: Any, body: Any, states: Any, radius: float, touched: Touched, contact: Situation) -> Any:
    """Return force, states and flag, as `apply_objects_effects`, for the effects of one object."""


@effects_of.of(0)
def effects_of_none(effects: Any, body: Any, states: Any, radius: float, touched: Touched, contact: Situation) -> Any:
    return (-0.0, -0.0, -0.0), (), 0.0  # see forces.apply_none


def effects_of_some(effects: Any, body: Any, states: Any, radius: float, touched: Touched, contact: Situation) -> Any:
    gap, _, normal, unsearched = closest_or_bound_on(body, contact.position)
    is_touched = 1.0
    # The normal of the contact, not of the nearest surface point: the probe may have passed through a thin body.
    if body.number == touched.one.body:
        normal = touched.one.normal
    elif body.number == touched.two.body:
        normal = touched.two.normal
    elif body.number == touched.three.body:
        normal = touched.three.normal
    else:
        is_touched = 0.0
    carrier, velocity = moving_pose(body.motion, body.pose), contact.velocity
    if contact.dt > 0.0:  # relative to this object
        way = vec3.sub(carried_along(body.was, body.pose, touched.before), touched.before)
        velocity = vec3.add_scaled(velocity, -1.0 / contact.dt, way)
    situation = Situation(
        position=contact.position, velocity=velocity, dt=contact.dt, touched=is_touched, gap=gap - radius,
        normal=normal, carrier=carrier,
    )  # fmt: skip
    force, after = apply_effects(effects, states, situation)
    return force, after, unsearched


effects_of.of(1)(effects_of_some)
effects_of.of(2)(effects_of_some)
