"""Effects of the workspace and of the objects on a fingertip in one tick, with or without contact."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.effects.forces import Situation, apply_effects
from softfinger.proxy.kernels.effects.objects import TouchedObjects, apply_objects_effects
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import ActiveSet, Finger, FingerState, Probe, Scene, Vec3
from softfinger.proxy.kernels.numerics import vec3


class Effects(NamedTuple):
    """Sum of all effects.

    force    (3,) N  total force
    states           of the effects, for the next tick
    unknown          1 if the gap of an object is unknown because the search for its nearest point did not finish,
                     otherwise 0
    """

    force: Vec3
    states: Any
    unknown: float


@jit
def sum_effects(
    scene: Scene,
    finger: Finger,
    objects: Any,
    state: FingerState,
    active: ActiveSet,
    probe: Probe,
    dt: float,
) -> Effects:
    """Evaluate the effects of the workspace and of the objects at the probe."""
    up, in_contact = (0.0, 0.0, 1.0), 0.0 if active[0].object_index < 0.0 else 1.0
    around = Situation(
        position=probe.position, velocity=probe.velocity, dt=dt, touched=in_contact, gap=0.0, normal=up, carrier=None
    )  # fmt: skip
    force, states = apply_effects(scene.effects, state.effects[0], around)
    contact = replace(around, "touched", 0.0)
    touched = TouchedObjects(active, state.probe.position)
    more, states_of_objects, unknown = apply_objects_effects(objects, state.effects[1], finger.radius, touched, contact)
    return Effects(vec3.add(force, more), (states, states_of_objects), unknown)
