"""The effects of the workspace and of the objects, as a fingertip feels them in a tick, in contact or out of it."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.effects.forces import Situation, apply_effects
from softfinger.proxy.kernels.effects.objects import Touched, apply_objects_effects
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import ActiveSet, Constraint, Finger, FingerState, Probe, Scene, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.query.objects import number_of


class Effects(NamedTuple):
    """Force (3,) N of all effects, what they remember, and 1 where the gap to an object is not known, because the
    search for its nearest point did not end; else 0."""

    force: Vec3
    states: Any
    unknown: float


@jit
def numbered(objects: Any, constraint: Constraint) -> Constraint:
    """With the object's number in the scene in place of its place in the tuple."""
    return Constraint(number_of(objects, constraint.body), constraint.normal, constraint.depth)


@jit
def effects_of_tick(
    scene: Scene,
    finger: Finger,
    objects: Any,
    state: FingerState,
    active: ActiveSet,
    probe: Probe,
    dt: float,
) -> Effects:
    """Those of the workspace and those of the objects."""
    up, in_contact = (0.0, 0.0, 1.0), 0.0 if active[0].body < 0.0 else 1.0
    around = Situation(
        position=probe.position, velocity=probe.velocity, dt=dt, touched=in_contact, gap=0.0, normal=up, carrier=None
    )  # fmt: skip
    force, states = apply_effects(scene.effects, state.effects[0], around)
    contact = Situation(
        position=probe.position, velocity=probe.velocity, dt=dt, touched=0.0, gap=0.0, normal=up, carrier=None
    )  # fmt: skip
    one, two, three = active
    touched = Touched(
        one=numbered(objects, one), two=numbered(objects, two), three=numbered(objects, three),
        before=state.probe.position,
    )  # fmt: skip
    more, states_of_objects, unknown = apply_objects_effects(objects, state.effects[1], finger.radius, touched, contact)
    return Effects(vec3.add(force, more), (states, states_of_objects), unknown)
