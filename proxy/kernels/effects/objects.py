"""The effects of the objects: each is told how the fingertip stands to its own object."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.effects.forces import Situation, apply_effects
from softfinger.proxy.kernels.jit.dispatch import by_count, by_type
from softfinger.proxy.kernels.model import Constraint, Many, Single, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.query.container import object_at
from softfinger.proxy.kernels.query.motion import carried_along, moving_pose
from softfinger.proxy.kernels.query.objects import closest_or_bound_on


class Touched(NamedTuple):
    """The up to three constraints that hold the proxy, by the numbers of their objects, -1 for none; where (3,) m the
    probe was at the last tick."""

    one: Constraint
    two: Constraint
    three: Constraint
    before: Vec3


@by_type
def apply_objects_effects(objects: Any, states: Any, radius: float, touched: Touched, contact: Situation) -> Any:
    """Sum of the forces (3,) N of all objects' effects, their states, and 1 where one of them was told a gap that may
    be too large, because the search for it did not end; else 0.

    states  a tuple for each object that has effects; of a single object one that may be empty
    """


@apply_objects_effects.of(Single)
def effects_of_single(objects: Single, states: Any, radius: float, touched: Touched, contact: Situation) -> Any:
    body = objects.body
    force, state, unsearched = effects_of(body.effects, body, states[0], radius, touched, contact)
    return force, (state,), unsearched


@apply_objects_effects.of(Many)
def effects_of_many(objects: Many, states: Any, radius: float, touched: Touched, contact: Situation) -> Any:
    return effects_of_carriers(objects.effects, objects, states, radius, touched, contact)


@by_count
def effects_of_carriers(
    carriers: Any, objects: Many, states: Any, radius: float, touched: Touched, contact: Situation
) -> Any:
    """The same of those of many objects that have effects."""


@effects_of_carriers.of(0)
def effects_of_no_carrier(
    carriers: Any, objects: Many, states: Any, radius: float, touched: Touched, contact: Situation
) -> Any:
    return (-0.0, -0.0, -0.0), (), 0.0  # see effects.apply_none


def effects_of_first_carrier(
    carriers: Any, objects: Many, states: Any, radius: float, touched: Touched, contact: Situation
) -> Any:
    carrier = carriers[0]
    body = object_at(objects, carrier.row)
    force, state, unsearched = effects_of(carrier.effects, body, states[0], radius, touched, contact)
    others, rest, more = effects_of_carriers(carriers[1:], objects, states[1:], radius, touched, contact)
    states = (state,) + rest  # noqa: RUF005  # numba joins tuples of known types, and does not unpack them
    return vec3.add(force, others), states, max(unsearched, more)


effects_of_carriers.of(1)(effects_of_first_carrier)
effects_of_carriers.of(2)(effects_of_first_carrier)


@by_count
def effects_of(effects: Any, body: Any, states: Any, radius: float, touched: Touched, contact: Situation) -> Any:
    """Force, states and, as above, whether a search did not end, of one object's effects."""


@effects_of.of(0)
def effects_of_none(effects: Any, body: Any, states: Any, radius: float, touched: Touched, contact: Situation) -> Any:
    return (-0.0, -0.0, -0.0), (), 0.0  # see effects.apply_none


def effects_of_some(effects: Any, body: Any, states: Any, radius: float, touched: Touched, contact: Situation) -> Any:
    gap, _, normal, unsearched = closest_or_bound_on(body, contact.position)
    is_touched = 1.0
    # The contact's normal, not that of the nearest surface point: the probe may be through a thin body.
    if body.number == touched.one.body:
        normal = touched.one.normal
    elif body.number == touched.two.body:
        normal = touched.two.normal
    elif body.number == touched.three.body:
        normal = touched.three.normal
    else:
        is_touched = 0.0
    carrier, velocity = moving_pose(body.motion, body.pose), contact.velocity
    if contact.dt > 0.0:  # against this object
        way = vec3.sub(carried_along(body, touched.before), touched.before)
        velocity = vec3.add_scaled(velocity, -1.0 / contact.dt, way)
    situation = Situation(
        position=contact.position, velocity=velocity, dt=contact.dt, touched=is_touched, gap=gap - radius,
        normal=normal, carrier=carrier,
    )  # fmt: skip
    force, after = apply_effects(effects, states, situation)
    return force, after, unsearched


effects_of.of(1)(effects_of_some)
effects_of.of(2)(effects_of_some)
