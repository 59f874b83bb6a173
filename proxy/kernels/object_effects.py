"""The effects of the objects: each is told how the fingertip stands to its own object."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels import vec3
from softfinger.proxy.kernels.bodies import closest_on
from softfinger.proxy.kernels.dispatch import by_count, by_type
from softfinger.proxy.kernels.effects import Moment, apply_effects
from softfinger.proxy.kernels.model import Driven, Pose, Sinusoid, Turntable, Vec3


class Touched(NamedTuple):
    """Numbers of the up to three objects that hold the proxy, -1 for none, and the normals there."""

    first: float
    second: float
    third: float
    n1: Vec3
    n2: Vec3
    n3: Vec3


@by_count
def apply_objects_effects(objects: Any, states: Any, radius: float, touched: Touched, contact: Moment) -> Any:
    """Sum of the forces (3,) N of all objects' effects, and their states."""


@apply_objects_effects.of(1)
def effects_of_one(objects: Any, states: Any, radius: float, touched: Touched, contact: Moment) -> Any:
    force, state = effects_of(objects[0].effects, objects[0], states[0], radius, touched, contact)
    return force, (state,)


@apply_objects_effects.of(2)
def effects_of_several(objects: Any, states: Any, radius: float, touched: Touched, contact: Moment) -> Any:
    force, state = effects_of(objects[0].effects, objects[0], states[0], radius, touched, contact)
    others, rest = apply_objects_effects(objects[1:], states[1:], radius, touched, contact)
    return vec3.add(force, others), (state,) + rest  # noqa: RUF005  # see place_several


@by_count
def effects_of(effects: Any, body: Any, states: Any, radius: float, touched: Touched, contact: Moment) -> Any:
    """Force and states of one object's effects."""


@effects_of.of(0)
def effects_of_none(effects: Any, body: Any, states: Any, radius: float, touched: Touched, contact: Moment) -> Any:
    return (-0.0, -0.0, -0.0), ()  # see effects.apply_none


def effects_of_some(effects: Any, body: Any, states: Any, radius: float, touched: Touched, contact: Moment) -> Any:
    gap, _, normal = closest_on(body, contact.position)
    is_touched = 1.0
    # The contact's normal, not that of the nearest surface point: the probe may be through a thin body.
    if body.number == touched.first:
        normal = touched.n1
    elif body.number == touched.second:
        normal = touched.n2
    elif body.number == touched.third:
        normal = touched.n3
    else:
        is_touched = 0.0
    carrier = carrier_of(body.motion, body.pose)
    moment = Moment(contact.position, contact.velocity, contact.dt, is_touched, gap - radius, normal, carrier)
    return apply_effects(effects, states, moment)


effects_of.of(1)(effects_of_some)
effects_of.of(2)(effects_of_some)


@by_type
def carrier_of(motion: Any, pose: Any) -> Any:
    """Pose of an object that moves, None for one that stands still."""


@carrier_of.of(None)
def no_carrier(motion: None, pose: Any) -> None:
    return None


def own_pose(motion: Any, pose: Pose) -> Pose:
    return pose


for _motion in (Sinusoid, Turntable, Driven):
    carrier_of.of(_motion)(own_pose)
