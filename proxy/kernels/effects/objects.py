"""Effects of all objects, each evaluated with the gap, normal and velocity relative to its object."""

from typing import Any

from softfinger.proxy.kernels.effects.forces import NO_FORCE, Situation, apply_effects
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import fold_each, map_each, unzip
from softfinger.proxy.kernels.model import ActiveSet, Carrier, ProbeMotion, Single, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.frames import into, turn_out_of
from softfinger.proxy.kernels.query.carry import make_carry, move_point
from softfinger.proxy.kernels.query.container import find_object
from softfinger.proxy.kernels.query.motion import select_moving_pose
from softfinger.proxy.kernels.query.objects import find_scene_index
from softfinger.proxy.kernels.shapes import closest_or_bound


@jit
def apply_objects_effects(
    objects: Any, states: Any, radius: float, active: ActiveSet, motion: ProbeMotion
) -> tuple[Vec3, Any, float]:
    """Return the total force (3,) N of the effects of all objects, the states after this tick, and a flag.

    The flag is 1 if the gap of an object may be too large because the search for its nearest point did not finish,
    otherwise 0.

    states  a tuple for each Carrier of the objects
    """
    results, after = unzip(map_each(apply_effects_of, (objects.effects, states), objects, radius, active, motion))
    force, unsearched = fold_each(add_forces, results, (NO_FORCE, 0.0))
    return force, after, unsearched


@jit
def add_forces(first: tuple[Vec3, float], second: tuple[Vec3, float]) -> tuple[Vec3, float]:
    """Return the sum of two forces (3,) N, and 1 if the search of either object did not finish, otherwise 0."""
    return vec3.add(first[0], second[0]), max(first[1], second[1])


@jit
def apply_effects_of(
    carrier: Carrier, states: Any, objects: Any, radius: float, active: ActiveSet, motion: ProbeMotion
) -> tuple[tuple[Vec3, float], Any]:
    """Return the force (3,) N of one object's effects with the flag of the search, and the states after this tick."""
    probe, last, dt = motion
    body = find_object(objects, carrier.row)
    whole = objects.body if isinstance(objects, Single) else body  # instead of one of its triangles
    gap, _, normal, unsearched = closest_or_bound(whole.shape, into(whole.pose, probe.position))
    is_touched, normal = find_contact_normal(objects, active, body.scene_index, turn_out_of(whole.pose, normal))
    velocity = probe.velocity
    if dt > 0.0:  # relative to this object
        displacement = vec3.sub(move_point(make_carry(body), last.position), last.position)
        velocity = vec3.add_scaled(velocity, -1.0 / dt, displacement)
    situation = Situation(
        position=probe.position, velocity=velocity, dt=dt, touched=is_touched, gap=gap - radius, normal=normal,
        carrier=select_moving_pose(body.motion, body.pose),
    )  # fmt: skip
    force, after = apply_effects(carrier.effects, states, situation)
    return (force, unsearched), after


@jit
def find_contact_normal(objects: Any, active: ActiveSet, scene_index: float, normal: Vec3) -> tuple[float, Vec3]:
    """Return 1 and the normal of the contact on object `scene_index` of the scene file, or 0 and `normal` without one.

    The normal of the nearest surface point differs from it if the probe has passed through a thin body.
    """
    one, two, three = active
    if scene_index == find_scene_index(objects, one.object_index):
        return 1.0, one.normal
    if scene_index == find_scene_index(objects, two.object_index):
        return 1.0, two.normal
    if scene_index == find_scene_index(objects, three.object_index):
        return 1.0, three.normal
    return 0.0, normal
