"""Contact step on an elastic surface: the rigid step with the probe shifted by the displacement of the surface.

    f_i = F(p_i - u_i),    u_i = sum_j C(x_i, x_j) f_j

F is the step on the undeformed mesh, f_i the load of finger i at x_i, u_i the displacement there. So the finger's
spring is in series with the surface, and friction, torsion and rolling act between the fingertip and the moving
surface. Newton's method solves for u with the slopes of the load and of the contact point, at most ROUNDS times. It
begins at the solution of the last tick, corrected for the motion of the probes with the matrix of the last tick, and
mostly ends after one more correction. Each round steps from the state of the last tick. If it does not converge, the
last round repeats the one with the least error, since any other may have the force of a rigid surface.

Source of the method: James and Pai (2001). This module is imported for scenes with an elastic object only.
"""

from collections.abc import Callable
from math import inf, pi
from typing import Any

from softfinger.proxy.kernels.elastic.spots import (
    ZERO,
    Spot,
    bending_under,
    compliance_of,
    compute_node_rows,
    contact_spot,
    empty_spot,
    hold_if_reversed,
    slope_at,
    slope_by,
    spot_of,
)
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import chosen_by
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import Contact, Finger, FingerState, Pose, Probe, Scene, State, Vec3
from softfinger.proxy.kernels.model.elastic import Elastic, Surface
from softfinger.proxy.kernels.numerics import mat3, vec3
from softfinger.proxy.kernels.numerics.frames import turn_into, turn_out_of
from softfinger.proxy.kernels.numerics.mat3 import Mat3
from softfinger.proxy.kernels.query.world import place_all
from softfinger.proxy.kernels.step import step_finger, step_once
from softfinger.proxy.record import FREE, LARGE_DISPLACEMENT, LARGE_ROTATION, LARGE_STRAIN, UNSOLVED

ROUNDS = 8
"""Largest number of rigid steps of a finger in a tick."""
SOLVED = 1e-11
"""Error of the displacement, m, below which it is not corrected: 0.01 uN for a finger of 1000 N/m."""
CLOSE = 1e-6
"""Error, m, below which the last round is a correction, too: it changes the force by 1 mN at 1000 N/m. A larger error
of the last round is reported as UNSOLVED."""
Blocks = tuple[tuple[Mat3, Mat3], tuple[Mat3, Mat3]]

ROTATION_MAX_RAD = 10.0 * pi / 180.0
STRAIN_MAX = 0.1
"""Rotation and strain above which the body is no longer linear."""


@jit
def shift_pose(body: Any, pose: Pose, surface: Vec3) -> Pose:
    """Return the pose relative to the displaced surface."""
    return Pose(vec3.sub(pose.position, turn_out_of(body.pose, surface)), pose.orientation)


@jit
def relative_to(body: Any, state: FingerState, surface: Vec3) -> FingerState:
    """Return the state of a finger with its probe relative to the displaced surface, where its contact is solved."""
    probe = state.probe
    moved = shift_pose(body, Pose(probe.position, probe.orientation), surface)
    return replace(state, "probe", Probe(moved.position, probe.orientation, probe.velocity))


@jit
def place_probe(state: FingerState, pose: Pose) -> FingerState:
    """Return the state of a finger with its probe in the world, where guard, passivity and record need it."""
    return replace(state, "probe", Probe(pose.position, pose.orientation, state.probe.velocity))


@jit
def drive_of(body: Any, last: Surface, state: FingerState, pose: Pose, gain: float) -> tuple[Vec3, Vec3]:
    """Return the motion (3,) m of the probe in this tick, and what drives the displacement relative to it.

    That is the motion less the part of the last change that a damped surface makes in any case. Both are in the object
    frame.
    """
    motion = turn_into(body.pose, vec3.sub(pose.position, state.probe.position))
    return motion, vec3.add_scaled(motion, gain - 1.0, last.change)


@jit
def expect(last: Surface, change: Vec3, largest: float) -> Vec3:
    """Return the displacement (3,) m after an expected change, unless this exceeds `largest`, m, or is not a number."""
    return vec3.add(last.displacement, change) if vec3.norm(change) <= largest else last.displacement


@jit
def share_in_tick(elastic: Elastic, dt: float) -> float:
    """Return the share of the new displacement that the surface reaches in a tick: 1 without damping."""
    if elastic.damping == 0.0:
        return 1.0
    return dt / (dt + elastic.damping)


@jit
def surface_after(
    scene: Scene, finger: Finger, last: Surface, displacement: Vec3, contact: Contact, bent: Any, dt: float
) -> Surface:
    """Return the displacement with its rate, filtered as the probe's velocity is, and the limits that are exceeded.

    bent  largest rotation, rad, and strain of the body, and the square of the error, m2, of the displacement
    """
    elastic, body, rate = scene.elastic, scene.objects.body, last.rate
    moved = vec3.sub(displacement, last.displacement)
    if dt > 0.0:
        gain = 1.0 / (finger.velocity_time_constant + dt)
        rate = vec3.add_scaled(vec3.scale_and_flush(finger.velocity_time_constant * gain, last.rate), gain, moved)
    beyond = 0.0
    if vec3.dot(displacement, displacement) > elastic.large * elastic.large:
        beyond += LARGE_DISPLACEMENT
    if bent[0] > ROTATION_MAX_RAD:
        beyond += LARGE_ROTATION
    if bent[1] > STRAIN_MAX:
        beyond += LARGE_STRAIN
    if bent[2] > CLOSE**2:
        beyond += UNSOLVED
    if contact.mode == FREE:
        return Surface(displacement, moved, last.inverse, rate, ZERO, 0.0)
    return Surface(displacement, moved, last.inverse, rate, turn_out_of(body.pose, displacement), beyond)


@jit
def report_on(body: Any, contact: Contact, surface: Surface, slope: Vec3) -> Contact:
    """Return the contact at its place on the deformed surface, with the force `slope` (3,) N, object frame, added.

    slope  part of the force that comes from the slope of the deformed surface. A contact without friction conserves
           energy only with it. A contact with friction has none: it dissipates more than a slope below the coefficient
           of friction returns.
    """
    moved, rate = turn_out_of(body.pose, surface.displacement), turn_out_of(body.pose, surface.rate)
    if contact.mode == FREE:
        return replace(contact, "velocity", vec3.add(contact.velocity, rate), "center", vec3.add(contact.center, moved))
    force = turn_out_of(body.pose, slope)
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
    gain = share_in_tick(elastic, dt)
    motion, drive = drive_of(body, last, state.fingers[0], poses[0], gain)
    inverse = last.inverse[0]
    largest = vec3.norm(motion) + vec3.norm(last.change)
    u = expect(last, vec3.sub(motion, mat3.times(inverse, drive)), largest)
    rest = vec3.scale(1.0 - gain, last.displacement)
    before = relative_to(body, state.fingers[0], last.displacement)
    least, best = inf, u
    for left in range(ROUNDS - 1, -1, -1):
        after, contact = step_finger(finger, before, shift_pose(body, poses[0], u), scene, objects, dt)
        spot = empty_spot()
        if contact.mode != FREE:
            spot = contact_spot(elastic, body, finger, before, after, contact, dt)
        rows = compute_node_rows(elastic, spot, spot)
        goal = vec3.add_scaled(rest, gain, mat3.times(compliance_of(spot, rows), spot.load))
        error = vec3.sub(goal, u)
        square = vec3.dot(error, error)
        if left == 0 or square <= SOLVED**2:
            break
        if square < least:
            least, best = square, u
        if left == 1 and square > CLOSE**2:
            u = best
            continue
        spot, added = hold_if_reversed(spot, error)
        error = vec3.add_scaled(error, gain, mat3.times(compliance_of(spot, rows), added))
        moves = mat3.plus(slope_at(spot, spot, rows), 1.0, slope_by(spot, spot, rows, rows))
        inverse = mat3.inverse(mat3.plus(mat3.IDENTITY, gain, moves))
        u = vec3.add(u, mat3.times(inverse, error))
    slope = ZERO
    # The surface at rest determines the slope even with damping. Otherwise slow cycles would generate energy.
    if body.material.friction is None:
        at = slope_at(spot, spot, rows)
        matrix = mat3.plus(mat3.plus(mat3.IDENTITY, 1.0, at), 1.0, slope_by(spot, spot, rows, rows))
        slope = mat3.times(mat3.inverse(mat3.transpose(matrix)), mat3.times(mat3.transpose(at), spot.load))
    surface = surface_after(scene, finger, last, u, contact, (*bending_under(elastic, spot), square), dt)
    surface = replace(surface, "inverse", (mat3.IDENTITY if contact.mode == FREE else inverse,))
    return (place_probe(after, poses[0]),), (report_on(body, contact, surface, slope),), (surface,)


@jit
def linearize_both(elastic: Elastic, one: Spot, two: Spot, rows: Any, gain: float) -> Any:
    """Return Newton's matrix of two fingers, four blocks (3, 3), and the gradients (3,) N of load times displacement.

    rows  of the nodes of `one` under loads at `one` and `two`, and of `two` at `two`
    """
    r11, r12, r22 = rows
    r21 = compute_node_rows(elastic, two, one)
    at_one = mat3.plus(slope_at(one, one, r11), 1.0, slope_at(one, two, r12))
    at_two = mat3.plus(slope_at(two, two, r22), 1.0, slope_at(two, one, r21))
    a = mat3.plus(mat3.IDENTITY, gain, mat3.plus(at_one, 1.0, slope_by(one, one, r11, r11)))
    b = mat3.plus(mat3.ZEROS, gain, slope_by(one, two, r12, r21))
    c = mat3.plus(mat3.ZEROS, gain, slope_by(two, one, r21, r12))
    d = mat3.plus(mat3.IDENTITY, gain, mat3.plus(at_two, 1.0, slope_by(two, two, r22, r22)))
    gradients = mat3.times(mat3.transpose(at_one), one.load), mat3.times(mat3.transpose(at_two), two.load)
    return (a, b, c, d), gradients


@jit
def invert_both(a: Mat3, b: Mat3, c: Mat3, d: Mat3) -> Blocks:
    """Return the rows of blocks of the inverse of ((a, b), (c, d))."""
    a_inverse = mat3.inverse(a)
    left, right = mat3.product(c, a_inverse), mat3.product(a_inverse, b)
    corner = mat3.inverse(mat3.plus(d, -1.0, mat3.product(left, b)))
    up = mat3.plus(mat3.ZEROS, -1.0, mat3.product(right, corner))
    down = mat3.plus(mat3.ZEROS, -1.0, mat3.product(corner, left))
    return (mat3.plus(a_inverse, -1.0, mat3.product(up, left)), up), (down, corner)


@jit
def times_both(blocks: Blocks, one: Vec3, two: Vec3) -> tuple[Vec3, Vec3]:
    (a, b), (c, d) = blocks
    return vec3.add(mat3.times(a, one), mat3.times(b, two)), vec3.add(mat3.times(c, one), mat3.times(d, two))


@press.of(2)
def press_two(fingers: Any, scene: Scene, objects: Any, state: State, poses: Any, dt: float) -> Any:
    elastic, body, last = scene.elastic, objects.body, state.world.surfaces
    gain = share_in_tick(elastic, dt)
    rest_u, rest_v = vec3.scale(1.0 - gain, last[0].displacement), vec3.scale(1.0 - gain, last[1].displacement)
    motion_u, drive_u = drive_of(body, last[0], state.fingers[0], poses[0], gain)
    motion_v, drive_v = drive_of(body, last[1], state.fingers[1], poses[1], gain)
    inverse = (last[0].inverse, last[1].inverse)
    left_u, left_v = times_both(inverse, drive_u, drive_v)
    largest = vec3.norm(motion_u) + vec3.norm(motion_v) + vec3.norm(last[0].change) + vec3.norm(last[1].change)
    u, v = expect(last[0], vec3.sub(motion_u, left_u), largest), expect(last[1], vec3.sub(motion_v, left_v), largest)
    before_one = relative_to(body, state.fingers[0], last[0].displacement)
    before_two = relative_to(body, state.fingers[1], last[1].displacement)
    x, y = empty_spot(), empty_spot()
    least, best = inf, (u, v)
    for left in range(ROUNDS - 1, -1, -1):
        one, first = step_finger(fingers[0], before_one, shift_pose(body, poses[0], u), scene, objects, dt)
        two, second = step_finger(fingers[1], before_two, shift_pose(body, poses[1], v), scene, objects, dt)
        is_loaded = first.mode != FREE or second.mode != FREE
        x = spot_of(elastic, objects, fingers[0], before_one, one, first, x, dt) if is_loaded else empty_spot()
        y = spot_of(elastic, objects, fingers[1], before_two, two, second, y, dt) if is_loaded else empty_spot()
        rows = compute_node_rows(elastic, x, x), compute_node_rows(elastic, x, y), compute_node_rows(elastic, y, y)
        coupling = compliance_of(x, rows[1])
        goal_u = vec3.add(mat3.times(compliance_of(x, rows[0]), x.load), mat3.times(coupling, y.load))
        goal_v = vec3.add(mat3.times(mat3.transpose(coupling), x.load), mat3.times(compliance_of(y, rows[2]), y.load))
        error_u = vec3.sub(vec3.add_scaled(rest_u, gain, goal_u), u)
        error_v = vec3.sub(vec3.add_scaled(rest_v, gain, goal_v), v)
        square = vec3.dot(error_u, error_u) + vec3.dot(error_v, error_v)
        if left == 0 or square <= SOLVED**2:
            break
        if square < least:
            least, best = square, (u, v)
        if left == 1 and square > CLOSE**2:
            u, v = best
            continue
        held_x, added_x = hold_if_reversed(x, error_u)
        held_y, added_y = hold_if_reversed(y, error_v)
        more_u = vec3.add(mat3.times(compliance_of(x, rows[0]), added_x), mat3.times(coupling, added_y))
        more_v = vec3.add(mat3.times(mat3.transpose(coupling), added_x), mat3.times(compliance_of(y, rows[2]), added_y))
        error_u, error_v = vec3.add_scaled(error_u, gain, more_u), vec3.add_scaled(error_v, gain, more_v)
        (a, b, c, d), _ = linearize_both(elastic, held_x, held_y, rows, gain)
        inverse = invert_both(a, b, c, d)
        change_u, change_v = times_both(inverse, error_u, error_v)
        u, v = vec3.add(u, change_u), vec3.add(v, change_v)
    slope_u, slope_v = ZERO, ZERO
    if body.material.friction is None:  # as for one finger
        (a, b, c, d), gradients = linearize_both(elastic, x, y, rows, 1.0)
        (a, b), (c, d) = invert_both(a, b, c, d)
        transposed = (mat3.transpose(a), mat3.transpose(c)), (mat3.transpose(b), mat3.transpose(d))
        slope_u, slope_v = times_both(transposed, gradients[0], gradients[1])
    bent_x, bent_y = bending_under(elastic, x), bending_under(elastic, y)
    bent = (bent_x[0] + bent_y[0], bent_x[1] + bent_y[1], square)
    surface_u = surface_after(scene, fingers[0], last[0], u, first, bent, dt)
    surface_v = surface_after(scene, fingers[1], last[1], v, second, bent, dt)
    if not is_loaded:
        inverse = ((mat3.IDENTITY, mat3.ZEROS), (mat3.ZEROS, mat3.IDENTITY))
    surface_u = replace(surface_u, "inverse", inverse[0])
    surface_v = replace(surface_v, "inverse", inverse[1])
    contacts = (report_on(body, first, surface_u, slope_u), report_on(body, second, surface_v, slope_v))
    return (place_probe(one, poses[0]), place_probe(two, poses[1])), contacts, (surface_u, surface_v)
