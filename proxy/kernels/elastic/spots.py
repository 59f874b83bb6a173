"""Spots of an elastic surface: contact points with their load, and the slopes of both."""

from math import sqrt
from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.normal import compute_normal_force
from softfinger.proxy.kernels.friction.stick_slip import SLIP_TOLERANCE
from softfinger.proxy.kernels.friction.viscous_slip import SLIP_TIME_CONSTANT_S
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import Contact, Finger, FingerState, Vec3
from softfinger.proxy.kernels.model.elastic import Elastic
from softfinger.proxy.kernels.model.vectors import ZERO
from softfinger.proxy.kernels.numerics import mat3, vec3
from softfinger.proxy.kernels.numerics.frames import into, turn_into
from softfinger.proxy.kernels.numerics.mat3 import Mat3
from softfinger.proxy.kernels.query.objects import NO_OBJECTS, find_closest_within, find_deepest
from softfinger.proxy.kernels.query.world import strip_materials
from softfinger.proxy.kernels.shapes.budget import QUEUE_SIZE
from softfinger.proxy.kernels.shapes.composite import NO_LIMIT_M
from softfinger.proxy.record import FREE, ROLLING

EDGE_WEIGHT = 1e-9
"""Barycentric weight below which a contact is on the edge of its facet."""
EDGE_TILT_RAD = 1e-6
"""Angle between the contact normal and that of the facet from which the contact is on an edge."""
LIMITED_SHARE = 1e-6
"""Share by which the cone has to reduce the friction of a contact that sticks, beyond rounding."""
DEPTH_STEP_M = 1e-7
"""Change of the depth by which the stiffness of the normal force is measured."""


class Spot(NamedTuple):
    """Contact point on a facet, in the object frame.

    nodes    (3,)        of the facet's corners, -1 at rigid vertices
    weights  (3,)        barycentric
    slopes   (3, 3) 1/m  gradients of the weights with the position of the probe; 0 while the contact sticks
    load     (3,) N      on the object
    spring   (3, 3) N/m  slope of the load with the position of the probe
    excess   (3,) N      friction on the finger that the cone removes
    stuck    (3, 3) N/m  `spring` without the cone
    """

    nodes: tuple[int, int, int]
    weights: Vec3
    slopes: Mat3
    load: Vec3
    spring: Mat3
    excess: Vec3
    stuck: Mat3


@jit
def make_empty_spot() -> Spot:
    """Return a spot without load on no facet."""
    return make_unloaded_spot((-1, -1, -1), ZERO, mat3.ZEROS)


@jit
def make_unloaded_spot(nodes: tuple[int, int, int], weights: Vec3, slopes: Mat3) -> Spot:
    return Spot(nodes, weights, slopes, load=ZERO, spring=mat3.ZEROS, excess=ZERO, stuck=mat3.ZEROS)


@jit
def make_spot(elastic: Elastic, body: Any, facet: float, point: Vec3, normal: Vec3) -> Spot:
    """Return the spot of a `point` (3,) m on a facet, without load; `normal` is that of the contact, world frame."""
    mesh, x, n = body.shape.row[0], into(body.pose, point), turn_into(body.pose, normal)
    first = 3 * int(facet)
    i, j, k = mesh.corners[first], mesh.corners[first + 1], mesh.corners[first + 2]
    a = (mesh.vertices[3 * i], mesh.vertices[3 * i + 1], mesh.vertices[3 * i + 2])
    b = (mesh.vertices[3 * j], mesh.vertices[3 * j + 1], mesh.vertices[3 * j + 2])
    c = (mesh.vertices[3 * k], mesh.vertices[3 * k + 1], mesh.vertices[3 * k + 2])
    ab, ac = vec3.sub(b, a), vec3.sub(c, a)
    up = vec3.cross(ab, ac)
    square = 1.0 / vec3.dot(up, up)
    to_b, to_c = vec3.scale(square, vec3.cross(ac, up)), vec3.scale(square, vec3.cross(up, ab))
    of_b = min(max(vec3.dot(vec3.sub(x, a), to_b), 0.0), 1.0)
    of_c = min(max(vec3.dot(vec3.sub(x, a), to_c), 0.0), 1.0 - of_b)
    of_a = 1.0 - of_b - of_c
    to_a = vec3.scale(-1.0, vec3.add(to_b, to_c))
    lean = vec3.cross(n, vec3.scale(sqrt(square), up))
    if vec3.dot(lean, lean) > EDGE_TILT_RAD**2:  # it can move only along the edge; at a corner it cannot
        along, edges = ZERO, 0
        for weight, edge in ((of_a, vec3.sub(c, b)), (of_b, ac), (of_c, ab)):
            if weight < EDGE_WEIGHT:
                along, edges = edge, edges + 1
        length = vec3.dot(along, along)
        scale = 1.0 / length if edges == 1 else 0.0
        to_a = vec3.scale(scale * vec3.dot(to_a, along), along)
        to_b = vec3.scale(scale * vec3.dot(to_b, along), along)
        to_c = vec3.scale(scale * vec3.dot(to_c, along), along)
    nodes = (int(elastic.nodes[i]), int(elastic.nodes[j]), int(elastic.nodes[k]))
    return make_unloaded_spot(nodes, (of_a, of_b, of_c), (to_a, to_b, to_c))


@jit
def extract_friction(law: Any, force: Vec3, normal: Vec3) -> Vec3:
    """Return the friction (3,) N in a force."""
    if law is None:
        return ZERO
    return vec3.reject(force, normal)


@jit
def make_contact_spot(
    elastic: Elastic, body: Any, finger: Finger, last: FingerState, state: FingerState, contact: Contact, dt: float
) -> Spot:
    """Return the spot of the most loaded contact, with the load of all contacts of the finger.

    last   state before the tick, relative to the surface
    state  state after the tick, relative to the surface
    """
    spot = make_spot(elastic, body, state.contacts[0].object_index, contact.contacts[0].point, contact.normal)
    force = ZERO
    for k in range(3):
        force = vec3.add(force, contact.contacts[k].force)
    force, n = turn_into(body.pose, force), turn_into(body.pose, contact.normal)
    spot = replace(spot, "load", vec3.scale(-1.0, force))
    law, depth, out = body.material.normal, contact.penetration, vec3.dot(contact.velocity, contact.normal)
    faster = out - DEPTH_STEP_M / dt if dt > 0.0 else out
    added_force = compute_normal_force(law, depth + DEPTH_STEP_M, faster) - compute_normal_force(law, depth, out)
    stiffness, along, spring = added_force / DEPTH_STEP_M, n, mat3.ZEROS
    tangent_projection = mat3.plus_outer(mat3.IDENTITY, vec3.scale(-1.0, n), n)
    drag = extract_friction(body.material.friction, force, n)
    size = vec3.norm(drag)
    side, unlimited = make_unlimited_friction(finger, last, state, contact, dt)
    length = vec3.norm(unlimited)
    stuck = mat3.plus_outer(mat3.plus(mat3.ZEROS, side, tangent_projection), vec3.scale(stiffness, n), n)
    if length <= (1.0 + LIMITED_SHARE) * size and (
        contact.mode == ROLLING or (size > 0.0 and not is_slipping(last, state, dt))
    ):
        return replace(spot, "slopes", mat3.ZEROS if side > 0.0 else spot.slopes, "spring", stuck)
    if length > size > 0.0:
        spot = replace(spot, "excess", vec3.sub(turn_into(body.pose, unlimited), drag), "stuck", stuck)
    if contact.normal_force > 0.0:
        along = vec3.add_scaled(n, 1.0 / contact.normal_force, vec3.reject(force, n))
        if size > 0.0:  # the cone limits the friction, which turns with the deflection
            t = vec3.scale(1.0 / size, drag)
            share = size / length if length > size else 1.0
            across = mat3.plus_outer(tangent_projection, vec3.scale(-1.0, t), t)
            spring = mat3.plus(mat3.ZEROS, share * side, across)
            moves = mat3.ZEROS  # of the point, with the probe
            if contact.mode != ROLLING:
                grip = size * stiffness / (contact.normal_force * side)
                moves = mat3.plus_outer(
                    mat3.plus(mat3.plus_outer(mat3.ZEROS, t, t), 1.0 - share, across), vec3.scale(-grip, n), t
                )
            a, b, c = spot.slopes
            spot = replace(spot, "slopes", (mat3.times(moves, a), mat3.times(moves, b), mat3.times(moves, c)))
    return replace(spot, "spring", mat3.plus_outer(spring, vec3.scale(stiffness, along), n))


@jit
def make_unlimited_friction(
    finger: Finger, last: FingerState, state: FingerState, contact: Contact, dt: float
) -> tuple[float, Vec3]:
    """Return the stiffness, N/m, of the spring along the surface, and its force (3,) N, before the cone limits it.

    A contact that starts to stick in this tick has no deflection, and follows the probe. The frame is the world.
    """
    before, spring = last.contacts[0].deflection, finger.coupling.stiffness
    if contact.mode != ROLLING:
        moved = vec3.sub(state.probe.position, last.probe.position)
        return spring, vec3.scale(spring, vec3.reject(vec3.sub(before, moved), contact.normal))
    if last.contacts[0].object_index < 0.0:
        return 0.0, ZERO
    now, damper = state.contacts[0].deflection, finger.coupling.damping / dt if dt > 0.0 else 0.0
    return spring + damper, vec3.add_scaled(vec3.scale(spring, now), damper, vec3.sub(now, before))


@jit
def is_slipping(last: FingerState, state: FingerState, dt: float) -> bool:
    """Return True if a sliding contact slips in this tick: without slip, the filtered speed only decays."""
    decay = SLIP_TIME_CONSTANT_S / (SLIP_TIME_CONSTANT_S + dt)
    return state.contacts[0].slip_speed > (1.0 + SLIP_TOLERANCE) * decay * last.contacts[0].slip_speed


@jit
def stick_if_reversed(spot: Spot, error: Vec3) -> tuple[Spot, Vec3]:
    """Return the spot as if it stuck if a correction by `error` (3,) m ends its slip, and the load (3,) N this adds.

    The load of a slipping contact does not change along its slip. On a surface softer than the finger's spring, a
    correction with this slope passes the place where the contact sticks, and the friction is reversed in each round.
    The load of a sticking contact is linear: one correction finds that place.
    """
    excess = spot.excess
    if vec3.dot(excess, vec3.add(excess, mat3.times(spot.stuck, error))) >= 0.0:
        return spot, ZERO
    load = vec3.sub(spot.load, excess)
    return replace(spot, "slopes", mat3.ZEROS, "load", load, "spring", spot.stuck), vec3.scale(-1.0, excess)


@jit
def find_nearest_spot(elastic: Elastic, objects: Any, position: Vec3) -> Spot:
    """Return the spot of the surface point nearest to a finger without contact."""
    shapes = strip_materials(objects)
    _, facet, remaining = find_deepest(shapes, position, NO_LIMIT_M, NO_OBJECTS, QUEUE_SIZE)
    if facet < 0.0 or remaining < 0:
        return make_empty_spot()
    _, point, normal, _ = find_closest_within(shapes, facet, position, remaining)
    return replace(make_spot(elastic, objects.body, facet, point, normal), "slopes", mat3.ZEROS)


@jit
def find_spot(
    elastic: Elastic,
    objects: Any,
    finger: Finger,
    last: FingerState,
    after: FingerState,
    contact: Contact,
    known: Spot,
    dt: float,
) -> Spot:
    """Return the spot of a finger, with or without contact.

    known  spot of the previous round of the tick, which a finger without contact retains: a search in each round
           costs more than the step, and its result hardly changes
    """
    if contact.mode != FREE:
        return make_contact_spot(elastic, objects.body, finger, last, after, contact, dt)
    if known.weights == ZERO:
        return find_nearest_spot(elastic, objects, after.probe.position)
    return make_unloaded_spot(known.nodes, known.weights, mat3.ZEROS)
