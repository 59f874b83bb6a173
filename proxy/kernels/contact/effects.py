"""Effects of the workspace and of the objects on a fingertip in one tick, with or without contact."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.effects.forces import Situation, apply_effects
from softfinger.proxy.kernels.effects.objects import apply_objects_effects
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import ActiveSet, Finger, FingerState, ProbeMotion, Scene, Vec3
from softfinger.proxy.kernels.numerics import vec3


class Effects(NamedTuple):
    """Sum of all effects.

    force    (3,) N  total force
    states           states of the effects after this tick
    unknown          1 if the gap of an object is unknown because the search for its nearest point did not finish,
                     otherwise 0
    """

    force: Vec3
    states: Any
    unknown: float


@jit
def sum_effects(
    scene: Scene, finger: Finger, objects: Any, state: FingerState, active: ActiveSet, motion: ProbeMotion
) -> Effects:
    """Evaluate the effects of the workspace and of the objects at the probe."""
    workspace = Situation(
        position=motion.probe.position, velocity=motion.probe.velocity, dt=motion.dt,
        touched=0.0 if active[0].object_index < 0.0 else 1.0, gap=0.0, normal=(0.0, 0.0, 1.0), carrier=None,
    )  # fmt: skip
    states, states_of_objects = state.effects
    force, states = apply_effects(scene.effects, states, workspace)
    of_objects, states_of_objects, unknown = apply_objects_effects(
        objects, states_of_objects, finger.radius, active, motion
    )
    return Effects(vec3.add(force, of_objects), (states, states_of_objects), unknown)
