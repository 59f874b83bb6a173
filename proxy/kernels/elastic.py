"""Contact step on an elastic surface: the rigid step with the probe shifted by the displacement of the surface.

    f_i = F(p_i - u_i),    u_i = sum_j C(x_i, x_j) f_j

F is the step on the undeformed mesh, f_i the load of finger i at x_i, u_i the displacement there. So the finger's
spring is in series with the surface, and friction, torsion and rolling act between the fingertip and the moving
surface. Newton's method solves for u with the slopes of the spring, at most ROUNDS times; it ends after one correction
while a contact sticks, or slides without friction on one facet. Each round steps from the state of the last tick.

Source of the method: James and Pai (2001). This module is imported for scenes with an elastic object only.
"""

from collections.abc import Callable
from math import pi, sqrt
from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.normal import normal_force_of
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type, chosen_by
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import Contact, Finger, FingerState, Pose, Probe, Scene, State, Vec3
from softfinger.proxy.kernels.model.elastic import Elastic, Surface
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.frames import into, turn_into, turn_out_of
from softfinger.proxy.kernels.query.objects import NOBODY, closest_to_within, deepest
from softfinger.proxy.kernels.query.world import all_bare, place_all
from softfinger.proxy.kernels.shapes.budget import ROOM
from softfinger.proxy.kernels.shapes.composite import EVERYWHERE
from softfinger.proxy.kernels.step import step_finger, step_once
from softfinger.proxy.record import FREE, LARGE_DISPLACEMENT, LARGE_ROTATION, LARGE_STRAIN, ROLLING

ROUNDS = 6
"""Largest number of rigid steps of a finger in a tick."""
SOLVED = 1e-11
"""Change of the displacement, m, below which it is not corrected: 0.01 uN for a finger of 1000 N/m."""
ON_EDGE = 1e-9
"""Barycentric weight below which a contact is on the edge of its facet."""
LEAN_RAD = 1e-6
"""Angle between the contact normal and that of the facet from which the contact is on an edge."""
DEPTH_STEP_M = 1e-7
"""Change of the depth by which the stiffness of the normal force is measured."""

ROTATION_MAX_RAD = 10.0 * pi / 180.0
STRAIN_MAX = 0.1
"""Rotation and strain above which the body is no longer linear."""

Mat3 = tuple[Vec3, Vec3, Vec3]
ZERO: Vec3 = (0.0, 0.0, 0.0)
ZEROS: Mat3 = (ZERO, ZERO, ZERO)
IDENTITY: Mat3 = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Spot(NamedTuple):
    """Contact point on a facet, in the object frame.

    nodes    of its corners, -1 where they do not give
    weights  barycentric
    slopes   gradients (3,) 1/m of the weights with the position of the probe; 0 while the contact sticks
    load     (3,) N    on the object
    spring   N/m       rows (3,) of the slope of the load with the position of the probe
    """

    nodes: tuple[int, int, int]
    weights: Vec3
    slopes: Mat3
    load: Vec3
    spring: Mat3


class Response(NamedTuple):
    """Compliance m/N between two spots, and the slopes of the displacement with the position of each.

    compliance  displacement at the first under unit loads at the second
    at          slope with the first position, under the load of the second
    by          slope with the second position
    """

    compliance: Mat3
    at: Mat3
    by: Mat3


@jit
def times(m: Mat3, v: Vec3) -> Vec3:
    return (vec3.dot(m[0], v), vec3.dot(m[1], v), vec3.dot(m[2], v))


@jit
def transposed(m: Mat3) -> Mat3:
    return ((m[0][0], m[1][0], m[2][0]), (m[0][1], m[1][1], m[2][1]), (m[0][2], m[1][2], m[2][2]))


@jit
def plus(a: Mat3, s: float, b: Mat3) -> Mat3:
    """Return a + s b."""
    return (vec3.add_scaled(a[0], s, b[0]), vec3.add_scaled(a[1], s, b[1]), vec3.add_scaled(a[2], s, b[2]))


@jit
def product(a: Mat3, b: Mat3) -> Mat3:
    columns = transposed(b)
    return (times(columns, a[0]), times(columns, a[1]), times(columns, a[2]))


@jit
def plus_outer(m: Mat3, a: Vec3, b: Vec3) -> Mat3:
    """Return m + a b^T."""
    return (vec3.add_scaled(m[0], a[0], b), vec3.add_scaled(m[1], a[1], b), vec3.add_scaled(m[2], a[2], b))


@jit
def inverse(m: Mat3) -> Mat3:
    a, b, c = vec3.cross(m[1], m[2]), vec3.cross(m[2], m[0]), vec3.cross(m[0], m[1])
    size = 1.0 / vec3.dot(m[0], a)
    return transposed((vec3.scale(size, a), vec3.scale(size, b), vec3.scale(size, c)))


@jit
def block_times(elastic: Elastic, a: int, b: int, v: Vec3) -> Vec3:
    """Return the displacement (3,) of node a under the load `v` (3,) on node b, times 1 Pa."""
    at = 9 * (a * int(elastic.number) + b)
    c = elastic.compliance
    return (
        c[at] * v[0] + c[at + 1] * v[1] + c[at + 2] * v[2],
        c[at + 3] * v[0] + c[at + 4] * v[1] + c[at + 5] * v[2],
        c[at + 6] * v[0] + c[at + 7] * v[1] + c[at + 8] * v[2],
    )


@jit
def add_block(m: Mat3, elastic: Elastic, a: int, b: int, weight: float) -> Mat3:
    """Return m plus the block of two nodes times `weight`."""
    at = 9 * (a * int(elastic.number) + b)
    c = elastic.compliance
    return (
        (m[0][0] + weight * c[at], m[0][1] + weight * c[at + 1], m[0][2] + weight * c[at + 2]),
        (m[1][0] + weight * c[at + 3], m[1][1] + weight * c[at + 4], m[1][2] + weight * c[at + 5]),
        (m[2][0] + weight * c[at + 6], m[2][1] + weight * c[at + 7], m[2][2] + weight * c[at + 8]),
    )


@jit
def respond(elastic: Elastic, one: Spot, two: Spot) -> Response:
    """Compute the response at `one` to loads at `two`."""
    compliance, at, by = ZEROS, ZEROS, ZEROS
    for i in range(3):
        if one.nodes[i] < 0:
            continue
        for j in range(3):
            if two.nodes[j] < 0:
                continue
            moved = block_times(elastic, one.nodes[i], two.nodes[j], two.load)
            compliance = add_block(
                compliance, elastic, one.nodes[i], two.nodes[j], elastic.softness * one.weights[i] * two.weights[j]
            )
            at = plus_outer(at, vec3.scale(elastic.softness * two.weights[j], moved), one.slopes[i])
            by = plus_outer(by, vec3.scale(elastic.softness * one.weights[i], moved), two.slopes[j])
    return Response(compliance, at, by)


@jit
def spot_on(elastic: Elastic, body: Any, facet: float, point: Vec3, normal: Vec3) -> Spot:
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
    if vec3.dot(lean, lean) > LEAN_RAD**2:  # the point stays on the edge, or at the corner
        along, edges = ZERO, 0
        for weight, edge in ((of_a, vec3.sub(c, b)), (of_b, ac), (of_c, ab)):
            if weight < ON_EDGE:
                along, edges = edge, edges + 1
        length = vec3.dot(along, along)
        scale = 1.0 / length if edges == 1 else 0.0
        to_a = vec3.scale(scale * vec3.dot(to_a, along), along)
        to_b = vec3.scale(scale * vec3.dot(to_b, along), along)
        to_c = vec3.scale(scale * vec3.dot(to_c, along), along)
    nodes = (int(elastic.nodes[i]), int(elastic.nodes[j]), int(elastic.nodes[k]))
    return Spot(nodes, (of_a, of_b, of_c), (to_a, to_b, to_c), ZERO, ZEROS)


@by_type
def friction_on(law: Any, force: Vec3, normal: Vec3) -> Any:
    """Return the friction (3,) N in a force."""


@friction_on.of(None)
def no_friction(law: None, force: Vec3, normal: Vec3) -> Vec3:
    return ZERO


@friction_on.otherwise
def tangential_part(law: Any, force: Vec3, normal: Vec3) -> Vec3:
    return vec3.reject(force, normal)


@jit
def contact_spot(elastic: Elastic, body: Any, finger: Finger, state: FingerState, contact: Contact, dt: float) -> Spot:
    """Return the spot of the most loaded contact, with the load of all contacts of the finger."""
    found = spot_on(elastic, body, state.contacts[0].body, contact.contacts[0].point, contact.normal)
    force = ZERO
    for k in range(3):
        force = vec3.add(force, contact.contacts[k].force)
    force, n = turn_into(body.pose, force), turn_into(body.pose, contact.normal)
    law, depth, out = body.material.normal, contact.penetration, vec3.dot(contact.velocity, contact.normal)
    faster = out - DEPTH_STEP_M / dt if dt > 0.0 else out
    more = normal_force_of(law, depth + DEPTH_STEP_M, faster) - normal_force_of(law, depth, out)
    stiffness, along = more / DEPTH_STEP_M, n
    if contact.mode == ROLLING:
        side = finger.coupling.stiffness + (finger.coupling.damping / dt if dt > 0.0 else 0.0)
        spring = plus(ZEROS, side, plus_outer(IDENTITY, vec3.scale(-1.0, n), n))
        spring = plus_outer(spring, vec3.scale(stiffness, n), n)
        return replace(found, "load", vec3.scale(-1.0, force), "slopes", ZEROS, "spring", spring)
    spring = ZEROS
    if contact.normal_force > 0.0:
        along = vec3.add_scaled(n, 1.0 / contact.normal_force, vec3.reject(force, n))
        drag = friction_on(body.material.friction, force, n)
        size = vec3.norm(drag)
        if size > 0.0:  # the friction turns with the deflection, and the point follows the probe along it
            t = vec3.scale(1.0 / size, drag)
            across = plus_outer(plus_outer(IDENTITY, vec3.scale(-1.0, n), n), vec3.scale(-1.0, t), t)
            spring = plus(ZEROS, finger.coupling.stiffness, across)
            a, b, c = found.slopes
            slopes = (vec3.scale(vec3.dot(a, t), t), vec3.scale(vec3.dot(b, t), t), vec3.scale(vec3.dot(c, t), t))
            found = replace(found, "slopes", slopes)
    spring = plus_outer(spring, vec3.scale(stiffness, along), n)
    return replace(found, "load", vec3.scale(-1.0, force), "spring", spring)


@jit
def nearest_spot(elastic: Elastic, objects: Any, position: Vec3) -> Spot:
    """Return the spot of the surface point nearest to a finger without contact."""
    shapes = all_bare(objects)
    _, facet, left = deepest(shapes, position, EVERYWHERE, NOBODY, ROOM)
    if facet < 0.0 or left < 0:
        return Spot((-1, -1, -1), ZERO, ZEROS, ZERO, ZEROS)
    _, point, normal, _ = closest_to_within(shapes, facet, position, left)
    return replace(spot_on(elastic, objects.body, facet, point, normal), "slopes", ZEROS)


@jit
def shifted(body: Any, pose: Pose, surface: Vec3) -> Pose:
    """Return the pose relative to the displaced surface."""
    return Pose(vec3.sub(pose.position, turn_out_of(body.pose, surface)), pose.orientation)


@jit
def relative_to(body: Any, state: FingerState, surface: Vec3) -> FingerState:
    """Return the state of a finger with its probe relative to the displaced surface, where its contact is solved."""
    probe = state.probe
    moved = shifted(body, Pose(probe.position, probe.orientation), surface)
    return replace(state, "probe", Probe(moved.position, probe.orientation, probe.velocity))


@jit
def with_probe_at(state: FingerState, pose: Pose) -> FingerState:
    """Return the state of a finger with its probe in the world, where guard, passivity and record need it."""
    return replace(state, "probe", Probe(pose.position, pose.orientation, state.probe.velocity))


@jit
def memory_of(elastic: Elastic, dt: float) -> float:
    """Return the share of the new displacement that the surface reaches in a tick: 1 without damping."""
    if elastic.damping == 0.0:
        return 1.0
    return dt / (dt + elastic.damping)


@jit
def surface_after(
    scene: Scene, finger: Finger, last: Surface, displacement: Vec3, contact: Contact, bent: Any, dt: float
) -> Surface:
    """Return the displacement with its rate, filtered as the probe's velocity is, and the limits that are exceeded.

    bent  largest rotation, rad, and strain of the body
    """
    elastic, body, rate = scene.elastic, scene.objects.body, last.rate
    if dt > 0.0:
        gain = 1.0 / (finger.velocity_time_constant + dt)
        moved = vec3.sub(displacement, last.displacement)
        rate = vec3.add_scaled(vec3.scale_and_flush(finger.velocity_time_constant * gain, last.rate), gain, moved)
    beyond = 0.0
    if vec3.dot(displacement, displacement) > elastic.large * elastic.large:
        beyond += LARGE_DISPLACEMENT
    if bent[0] > ROTATION_MAX_RAD:
        beyond += LARGE_ROTATION
    if bent[1] > STRAIN_MAX:
        beyond += LARGE_STRAIN
    if contact.mode == FREE:
        return Surface(displacement, rate, ZERO, 0.0)
    return Surface(displacement, rate, turn_out_of(body.pose, displacement), beyond)


@jit
def bending_under(elastic: Elastic, spot: Spot) -> tuple[float, float]:
    """Return the largest rotation, rad, and strain of the body under the load of a spot: an upper bound.

    Those of the components of the load on each node are added, wherever in the body they are.
    """
    rotation, strain = 0.0, 0.0
    for i in range(3):
        if spot.nodes[i] < 0:
            continue
        for j in range(3):
            share = elastic.softness * spot.weights[i] * abs(spot.load[j])
            at = 6 * spot.nodes[i] + 2 * j
            rotation += share * elastic.bending[at]
            strain += share * elastic.bending[at + 1]
    return rotation, strain


@by_type
def tilt(law: Any, contact: Contact, force: Vec3) -> Any:
    """Return the part (3,) N of the force that comes from the slope of the deformed surface: none with friction.

    A contact without friction conserves energy only with it. With friction the contact dissipates more than a slope
    below the coefficient of friction returns.
    """


@tilt.of(None)
def tilt_without_friction(law: None, contact: Contact, force: Vec3) -> Vec3:
    return force if contact.mode != FREE else ZERO


@tilt.otherwise
def no_tilt(law: Any, contact: Contact, force: Vec3) -> Vec3:
    return ZERO


@jit
def report_on(body: Any, contact: Contact, surface: Surface, slope: Vec3) -> Contact:
    """Return the contact at its place on the deformed surface, with the force `slope` (3,) N, object frame, added."""
    moved, rate = turn_out_of(body.pose, surface.displacement), turn_out_of(body.pose, surface.rate)
    if contact.mode == FREE:
        return replace(contact, "velocity", vec3.add(contact.velocity, rate), "center", vec3.add(contact.center, moved))
    force = tilt(body.material.friction, contact, turn_out_of(body.pose, slope))
    one, two, three = contact.contacts
    one = replace(one, "point", vec3.add(one.point, moved), "force", vec3.add(one.force, force))
    two = replace(two, "point", vec3.add(two.point, moved))
    three = replace(three, "point", vec3.add(three.point, moved))
    return replace(
        contact,
        "velocity", vec3.add(contact.velocity, rate),
        "center", vec3.add(contact.center, moved),
        "point", vec3.add(contact.point, moved),
        "force", vec3.add(contact.force, force),
        "contacts", (one, two, three),
    )  # fmt: skip


@step_once.of(Elastic)
def step_on_elastic(scene: Scene, state: State, poses: Any, dt: float) -> Any:
    """Compute one contact step of one or two fingers on the elastic object."""
    world = replace(state.world, "started", 1.0, "time", state.world.time + dt)
    objects = place_all(scene.objects, world)
    fingers, contacts, surfaces = press(scene.fingers, scene, objects, state, poses, dt)
    return State(world=replace(world, "surfaces", surfaces), fingers=fingers), contacts


def by_number(declaration: Callable[..., Any]) -> Any:
    """Declare a kernel chosen by the number of fingers: `.of(1)`, `.of(2)`."""
    return chosen_by(declaration, len, lambda count: count, len)


@by_number
def press(fingers: Any, scene: Scene, objects: Any, state: State, poses: Any, dt: float) -> Any:
    """Return FingerState, Contact and Surface of each finger."""


@press.of(1)
def press_one(fingers: Any, scene: Scene, objects: Any, state: State, poses: Any, dt: float) -> Any:
    elastic, body, last, finger = scene.elastic, objects.body, state.world.surfaces[0], fingers[0]
    gain = memory_of(elastic, dt)
    rest, slope, bent = vec3.scale(1.0 - gain, last.displacement), ZERO, (0.0, 0.0)
    u = vec3.add_scaled(last.displacement, dt, last.rate)
    before = relative_to(body, state.fingers[0], last.displacement)
    for left in range(ROUNDS - 1, -1, -1):
        after, contact = step_finger(finger, before, shifted(body, poses[0], u), scene, objects, dt)
        goal, matrix, rise, bent = rest, IDENTITY, ZERO, (0.0, 0.0)
        if contact.mode != FREE:
            spot = contact_spot(elastic, body, finger, after, contact, dt)
            given, bent = respond(elastic, spot, spot), bending_under(elastic, spot)
            goal = vec3.add_scaled(rest, gain, times(given.compliance, spot.load))
            moves = plus(plus(product(given.compliance, spot.spring), 1.0, given.at), 1.0, given.by)
            matrix, rise = inverse(plus(IDENTITY, gain, moves)), times(transposed(given.at), spot.load)
        slope = times(transposed(matrix), vec3.scale(gain, rise))
        change = times(matrix, vec3.sub(goal, u))
        if left == 0 or vec3.dot(change, change) <= SOLVED**2:
            break
        u = vec3.add(u, change)
    surface = surface_after(scene, finger, last, u, contact, bent, dt)
    return (with_probe_at(after, poses[0]),), (report_on(body, contact, surface, slope),), (surface,)


@jit
def spot_of(elastic: Elastic, objects: Any, finger: Finger, after: FingerState, contact: Contact, dt: float) -> Spot:
    """Return the spot of a finger, with or without contact."""
    if contact.mode == FREE:
        return nearest_spot(elastic, objects, after.probe.position)
    return contact_spot(elastic, objects.body, finger, after, contact, dt)


@jit
def correct_both(elastic: Elastic, one: Spot, two: Spot, gain: float, short: Any) -> Any:
    """Solve Newton's equations of two fingers.

    short    displacements (3,) m that are wanted less those without the loads, as functions of the loads, of each
    returns  corrections (3,) m, and forces (3,) N of the slope of the surface
    """
    r11, r12 = respond(elastic, one, one), respond(elastic, one, two)
    r21, r22 = respond(elastic, two, one), respond(elastic, two, two)
    goal_one = vec3.add(times(r11.compliance, one.load), times(r12.compliance, two.load))
    goal_two = vec3.add(times(r21.compliance, one.load), times(r22.compliance, two.load))
    lack_one, lack_two = vec3.add_scaled(short[0], gain, goal_one), vec3.add_scaled(short[1], gain, goal_two)
    at_one, at_two = plus(r11.at, 1.0, r12.at), plus(r21.at, 1.0, r22.at)
    a = plus(IDENTITY, gain, plus(plus(product(r11.compliance, one.spring), 1.0, at_one), 1.0, r11.by))
    d = plus(IDENTITY, gain, plus(plus(product(r22.compliance, two.spring), 1.0, at_two), 1.0, r22.by))
    b = plus(ZEROS, gain, plus(product(r12.compliance, two.spring), 1.0, r12.by))
    c = plus(ZEROS, gain, plus(product(r21.compliance, one.spring), 1.0, r21.by))
    a_inverse = inverse(a)
    left = product(c, a_inverse)
    rest = inverse(plus(d, -1.0, product(left, b)))
    second = times(rest, vec3.sub(lack_two, times(left, lack_one)))
    first = times(a_inverse, vec3.sub(lack_one, times(b, second)))
    # The same with the transposed matrix.
    rise_one = vec3.scale(gain, times(transposed(at_one), one.load))
    rise_two = vec3.scale(gain, times(transposed(at_two), two.load))
    right = transposed(product(a_inverse, b))
    slope_two = times(transposed(rest), vec3.sub(rise_two, times(right, rise_one)))
    slope_one = times(transposed(a_inverse), vec3.sub(rise_one, times(transposed(c), slope_two)))
    return first, second, slope_one, slope_two


@press.of(2)
def press_two(fingers: Any, scene: Scene, objects: Any, state: State, poses: Any, dt: float) -> Any:
    elastic, body, last = scene.elastic, objects.body, state.world.surfaces
    gain = memory_of(elastic, dt)
    rest_u, rest_v = vec3.scale(1.0 - gain, last[0].displacement), vec3.scale(1.0 - gain, last[1].displacement)
    u = vec3.add_scaled(last[0].displacement, dt, last[0].rate)
    v = vec3.add_scaled(last[1].displacement, dt, last[1].rate)
    slope_u, slope_v = ZERO, ZERO
    before_one = relative_to(body, state.fingers[0], last[0].displacement)
    before_two = relative_to(body, state.fingers[1], last[1].displacement)
    for left in range(ROUNDS - 1, -1, -1):
        one, first = step_finger(fingers[0], before_one, shifted(body, poses[0], u), scene, objects, dt)
        two, second = step_finger(fingers[1], before_two, shifted(body, poses[1], v), scene, objects, dt)
        x = spot_of(elastic, objects, fingers[0], one, first, dt)
        y = spot_of(elastic, objects, fingers[1], two, second, dt)
        short = (vec3.sub(rest_u, u), vec3.sub(rest_v, v))
        change_u, change_v, slope_u, slope_v = correct_both(elastic, x, y, gain, short)
        if left == 0 or vec3.dot(change_u, change_u) + vec3.dot(change_v, change_v) <= SOLVED**2:
            break
        u, v = vec3.add(u, change_u), vec3.add(v, change_v)
    bent_x, bent_y = bending_under(elastic, x), bending_under(elastic, y)
    bent = (bent_x[0] + bent_y[0], bent_x[1] + bent_y[1])
    surface_u = surface_after(scene, fingers[0], last[0], u, first, bent, dt)
    surface_v = surface_after(scene, fingers[1], last[1], v, second, bent, dt)
    contacts = (report_on(body, first, surface_u, slope_u), report_on(body, second, surface_v, slope_v))
    return (with_probe_at(one, poses[0]), with_probe_at(two, poses[1])), contacts, (surface_u, surface_v)
