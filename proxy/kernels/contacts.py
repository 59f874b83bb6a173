"""Which objects hold the proxy, how hard, and where it comes to rest.

The proxy is the point nearest the probe (displaced by the deflection that friction holds) that
satisfies every constraint. One object is the common case and is solved on its own; with several, the
objects that held the proxy last are kept and asked again, what stands in the way is added, and the
smallest push that satisfies them all is found, until nothing changes.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels import vec3
from softfinger.proxy.kernels.bodies import closest_on, closest_to, deepest, material_of
from softfinger.proxy.kernels.constraints import Push, displacement, smallest_push
from softfinger.proxy.kernels.dispatch import by_count, by_type
from softfinger.proxy.kernels.friction import static_coefficient
from softfinger.proxy.kernels.jit import jit
from softfinger.proxy.kernels.model import (
    Box,
    CappedCylinder,
    Capsule,
    Cylinder,
    Ellipsoid,
    Plane,
    Sphere,
    State,
    Torus,
    Vec3,
)
from softfinger.proxy.kernels.sweep import first_hit

ROUNDS = 10
"""Linearisations of curved surfaces at the proxy; each gains the digits that depth over radius of curvature allows."""
SLIDING_ROUNDS = 2
"""The same for a proxy that slides: what is left is far below the slip of one tick, and the next tick takes it up."""
SAME_SIDE = 0.5
"""Cosine between two normals of one side of an object, one tick apart: a fingertip does not turn round it in a tick."""
SETTLED = 1e-13
"""Movement, as a share of the fingertip's radius, below which the proxy is at rest."""
INSIDE = 1e-10
"""Depth, as a share of the fingertip's radius, that counts as inside an object and not as rounding."""
NONE = -1.0


class Held(NamedTuple):
    """Objects that hold the proxy.

    first, second, third   places in the scene's tuple, -1 for none; the first is the one that is rolled on
    n1, n2, n3             (3,) 1   normals
    push                   m        weights: how far the probe lies behind the proxy along each normal
    """

    first: float
    second: float
    third: float
    n1: Vec3
    n2: Vec3
    n3: Vec3
    push: Push


@jit
def hold_by(first: float, normal: Vec3) -> Held:
    """Held by one object alone, not yet pressed."""
    return Held(first, NONE, NONE, normal, normal, normal, Push(0.0, 0.0, 0.0))


@by_count
def hold_again(objects: Any, state: State, normal: Vec3) -> Any:
    """Held by what held at the last tick, by the first of them with `normal`; not yet pressed."""


@hold_again.of(1)
def hold_by_the_only_one(objects: Any, state: State, normal: Vec3) -> Held:
    return hold_by(0.0, normal)


@hold_again.of(2)
def hold_by_several(objects: Any, state: State, normal: Vec3) -> Held:
    return Held(state.first, state.second, state.third, normal, normal, normal, Push(0.0, 0.0, 0.0))


@jit
def count_of(held: Held) -> int:
    if held.second < 0.0:
        return 1
    return 2 if held.third < 0.0 else 3


@jit
def pressed(held: Held, behind: Vec3) -> Held:
    """The weights for a proxy at rest on all of them that lies `behind` (3,) m ahead of the probe."""
    n1, n2, n3 = held.n1, held.n2, held.n3
    demands = vec3.dot(behind, n1), vec3.dot(behind, n2), vec3.dot(behind, n3)
    push = smallest_push(count_of(held), n1, n2, n3, demands[0], demands[1], demands[2])
    return Held(held.first, held.second, held.third, n1, n2, n3, push)


@by_count
def displacement_by(objects: Any, held: Held) -> Any:
    """How far (3,) m what holds the proxy keeps it from where the probe and friction would have it."""


@displacement_by.of(1)
def displacement_by_one(objects: Any, held: Held) -> Vec3:
    return vec3.scale(held.push.first, held.n1)


@displacement_by.of(2)
def displacement_by_several(objects: Any, held: Held) -> Vec3:
    return displacement(held.push, held.n1, held.n2, held.n3)


@by_count
def find_others(objects: Any, radius: float, center: Vec3, held: Held) -> Any:
    """`held` with the normals of its second and third object at the proxy."""


@find_others.of(1)
def no_others(objects: Any, radius: float, center: Vec3, held: Held) -> Held:
    return held


@find_others.of(2)
def find_second_and_third(objects: Any, radius: float, center: Vec3, held: Held) -> Held:
    n2, n3 = held.n1, held.n1
    if held.second >= 0.0:
        _, _, n2 = closest_to(objects, held.second, center)
    if held.third >= 0.0:
        _, _, n3 = closest_to(objects, held.third, center)
    return Held(held.first, held.second, held.third, held.n1, n2, n3, held.push)


@by_count
def settle(objects: Any, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, held: Held, slips: bool) -> Any:
    """Bring the proxy to rest.

    center      (3,) m  where it was
    deflection  (3,) m  what friction keeps between proxy and probe, tangent
    slips               False where friction holds it: among several objects another may push it even so
    returns     center, Held, status: 0, or 1 where no point outside all objects was found and it stays
    """


@settle.of(1)
def settle_on_one(
    objects: Any, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, held: Held, slips: bool
) -> tuple[Vec3, Held, int]:
    if not slips:
        return center, held, 0
    center, normal = rest_on(objects[0].shape, objects[0], radius, probe, center, deflection, held.n1)
    return center, pressed(hold_by(0.0, normal), vec3.sub(center, probe)), 0


@by_type
def rest_on(shape: Any, body: Any, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, normal: Vec3) -> Any:
    """Proxy and normal on a single object."""


@rest_on.of(Plane)
def rest_on_plane(
    shape: Plane, body: Any, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> tuple[Vec3, Vec3]:
    """Found from the probe alone, so that a tick does not wait for the last one's proxy."""
    gap, _, normal = closest_on(body, probe)
    return vec3.add(probe, vec3.add_scaled(deflection, radius - gap, normal)), normal


def rest_on_curved(
    shape: Any, body: Any, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, normal: Vec3
) -> tuple[Vec3, Vec3]:
    """Project the probe onto the tangent plane, put that onto the surface, and again from there.

    Without a deflection the answer is the surface point nearest to the probe, unless that one is on another
    side of the object: then the normal has jumped, and the proxy goes its way round.
    """
    if deflection == (0.0, 0.0, 0.0):
        _, point, foot_normal = closest_on(body, probe)
        if vec3.dot(foot_normal, normal) > SAME_SIDE:
            return vec3.add_scaled(point, radius, foot_normal), foot_normal
    near, rounds = (SETTLED * radius) ** 2, SLIDING_ROUNDS
    if deflection == (0.0, 0.0, 0.0):
        rounds = ROUNDS
    for _ in range(rounds):
        depth = vec3.dot(vec3.sub(center, probe), normal)
        goal = vec3.add(probe, vec3.add_scaled(vec3.reject(deflection, normal), depth, normal))
        _, point, normal = closest_on(body, goal)
        moved = vec3.add_scaled(point, radius, normal)
        step = vec3.sub(moved, center)
        center = moved
        if vec3.dot(step, step) <= near:
            break
    return center, normal


for _kind in (Sphere, Cylinder, CappedCylinder, Capsule, Box, Ellipsoid, Torus):
    rest_on.of(_kind)(rest_on_curved)


@settle.of(2)
def settle_among_several(
    objects: Any, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, held: Held, slips: bool
) -> tuple[Vec3, Held, int]:
    before, held_before = center, held
    base = vec3.add(probe, deflection)
    goal = vec3.add(base, displacement(held.push, held.n1, held.n2, held.n3))
    for _ in range(4):
        skip = (held.first, held.second, held.third)
        share, hit = first_hit(objects, center, goal, radius, skip)
        if hit < 0.0:
            break
        stop = vec3.add_scaled(center, share, vec3.sub(goal, center))
        _, point, normal = closest_to(objects, hit, stop)
        if held.second >= 0.0 and held.third >= 0.0:
            # Held on three sides already: stop short of the fourth, and let the next tick sort it out.
            goal = stop
            break
        held = also_held(held, hit, normal)
        center, held = relax(objects, radius, base, vec3.add_scaled(point, radius, normal), held, 1)
        goal, center = center, before
    center = goal
    status = 1
    for _ in range(4):
        center, held = relax(objects, radius, base, center, held, ROUNDS)
        gap, at = deepest(objects, center)
        if gap >= radius * (1.0 - INSIDE):
            status = 0
            break
        if at != held.first and at != held.second and at != held.third:
            if held.second >= 0.0 and held.third >= 0.0:
                held = without_weakest(held)
            _, _, normal = closest_to(objects, at, center)
            held = also_held(held, at, normal)
    if status != 0:
        center, held = before, held_before
    return center, strongest_first(pressed(held, vec3.sub(center, probe))), status


@jit
def relax(objects: Any, radius: float, base: Vec3, center: Vec3, held: Held, rounds: int) -> tuple[Vec3, Held]:
    """Nearest point to `base` behind the tangent planes of all holding objects, again and again at the new point."""
    near = (SETTLED * radius) ** 2
    n1, n2, n3 = held.n1, held.n2, held.n3
    push = held.push
    for _ in range(rounds):
        _, point, n1 = closest_to(objects, held.first, center)
        b1 = vec3.dot(n1, vec3.sub(point, base)) + radius
        n2, b2, n3, b3 = n1, b1, n1, b1
        if held.second >= 0.0:
            _, point, n2 = closest_to(objects, held.second, center)
            b2 = vec3.dot(n2, vec3.sub(point, base)) + radius
        if held.third >= 0.0:
            _, point, n3 = closest_to(objects, held.third, center)
            b3 = vec3.dot(n3, vec3.sub(point, base)) + radius
        push = smallest_push(count_of(held), n1, n2, n3, b1, b2, b3)
        moved = vec3.add(base, displacement(push, n1, n2, n3))
        step = vec3.sub(moved, center)
        center = moved
        if vec3.dot(step, step) <= near:
            break
    return center, Held(held.first, held.second, held.third, n1, n2, n3, push)


@jit
def also_held(held: Held, index: float, normal: Vec3) -> Held:
    if held.second < 0.0:
        return Held(held.first, index, NONE, held.n1, normal, normal, held.push)
    return Held(held.first, held.second, index, held.n1, held.n2, normal, held.push)


@jit
def without_weakest(held: Held) -> Held:
    """Let go of the one of three that pushes least, to make room."""
    push = held.push
    if push.third <= push.second and push.third <= push.first:
        return Held(held.first, held.second, NONE, held.n1, held.n2, held.n2, push)
    if push.second <= push.first:
        return Held(held.first, held.third, NONE, held.n1, held.n3, held.n3, push)
    return Held(held.second, held.third, NONE, held.n2, held.n3, held.n3, push)


@jit
def strongest_first(held: Held) -> Held:
    """Drop what does not push, and roll on another object only when the first has clearly become the weaker one.

    A plain comparison would change between two equal walls with every rounding error.
    """
    push = held.push
    if held.third >= 0.0 and not push.third > 0.0:
        held = Held(held.first, held.second, NONE, held.n1, held.n2, held.n2, Push(push.first, push.second, 0.0))
    if held.second >= 0.0 and not push.second > 0.0:
        held = Held(
            held.first, held.third, NONE, held.n1, held.n3, held.n3, Push(held.push.first, held.push.third, 0.0)
        )
    push = held.push
    if held.second >= 0.0 and push.second > 1.5 * push.first and push.second >= push.third:
        return Held(
            held.second, held.first, held.third, held.n2, held.n1, held.n3, Push(push.second, push.first, push.third)
        )
    if held.third >= 0.0 and push.third > 1.5 * push.first:
        return Held(
            held.third, held.second, held.first, held.n3, held.n2, held.n1, Push(push.third, push.second, push.first)
        )
    return held


class Load(NamedTuple):
    """What the holding objects press with.

    force     (3,) N  the sum of what they press with, on the hand
    total     N       its magnitude
    friction  N       the normal force that, on the first object's material, allows the friction of all
    """

    force: Vec3
    total: float
    friction: float


@jit
def press(material: Any, depth: float, speed: float) -> float:
    """Normal force f_N = K delta - B v . n, kept between 0 and 2 K delta: never pulling, at most doubled by damping."""
    elastic = material.stiffness * depth
    return min(max(elastic - material.damping * speed, 0.0), max(2.0 * elastic, 0.0))


@by_count
def load_of(objects: Any, held: Held, velocity: Vec3) -> Any:
    """Normal forces for a probe that moves with `velocity` (3,) m/s against the objects."""


@load_of.of(1)
def load_of_one(objects: Any, held: Held, velocity: Vec3) -> Load:
    normal_force = press(objects[0].material, held.push.first, vec3.dot(velocity, held.n1))
    return Load(vec3.scale(normal_force, held.n1), normal_force, normal_force)


@load_of.of(2)
def load_of_several(objects: Any, held: Held, velocity: Vec3) -> Load:
    material = material_of(objects, held.first)
    first = press(material, held.push.first, vec3.dot(velocity, held.n1))
    force, friction = vec3.scale(first, held.n1), first
    grip = static_coefficient(material.friction)
    if held.second >= 0.0:
        other = material_of(objects, held.second)
        second = press(other, held.push.second, vec3.dot(velocity, held.n2))
        force = vec3.add_scaled(force, second, held.n2)
        if grip > 0.0:
            friction += second * static_coefficient(other.friction) / grip
    if held.third >= 0.0:
        other = material_of(objects, held.third)
        third = press(other, held.push.third, vec3.dot(velocity, held.n3))
        force = vec3.add_scaled(force, third, held.n3)
        if grip > 0.0:
            friction += third * static_coefficient(other.friction) / grip
    return Load(force, vec3.norm(force), friction)


@jit
def tangent_to_all(held: Held, v: Vec3) -> Vec3:
    """Part of `v` along which all holding objects leave the proxy free."""
    v = vec3.reject(v, held.n1)
    if held.second >= 0.0:
        across = vec3.reject(held.n2, held.n1)
        size = vec3.dot(across, across)
        if size > 1e-18:
            v = vec3.add_scaled(v, -vec3.dot(v, across) / size, across)
            if held.third >= 0.0:
                return (0.0, 0.0, 0.0)
    return v
