"""Contact step on an elastic surface: the rigid step with the probe shifted by the displacement of the surface.

    f_i = F(p_i - u_i),    u_i = sum_j C(x_i, x_j) f_j

F is the step on the undeformed mesh, f_i the load of finger i at x_i, u_i the displacement there. So the finger's
spring is in series with the surface, and friction, torsion and rolling act between the fingertip and the moving
surface. Newton's method solves for u with the slopes of the load and of the contact point, at most MAX_RIGID_STEPS
times. Its first value is the solution of the last tick, corrected for the motion of the probes with the matrix of the
last tick; mostly one more correction is enough. Each round steps from the state of the last tick. If it does not
converge, the last round repeats the one with the least error, since any other may have the force of a rigid surface.

Source of the method: James and Pai (2001). This module is imported for scenes with an elastic object only.
"""

from math import inf
from typing import Any

from softfinger.proxy.kernels.elastic.response import (
    compute_node_rows,
    compute_slope,
    compute_slope_by,
    find_bending,
    invert_both,
    linearize_both,
    multiply_both,
    read_compliance,
)
from softfinger.proxy.kernels.elastic.spots import (
    find_spot,
    make_contact_spot,
    make_empty_spot,
    stick_if_reversed,
)
from softfinger.proxy.kernels.elastic.surfaces import (
    CORRECTION_ERROR_M,
    compute_drive,
    compute_gain,
    move_into_surface,
    place_probe,
    predict_displacement,
    report_surface,
    shift_pose,
    update_surface,
)
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import Scene, State, Vec3
from softfinger.proxy.kernels.model.elastic import Elastic
from softfinger.proxy.kernels.model.vectors import ZERO
from softfinger.proxy.kernels.numerics import mat3, vec3
from softfinger.proxy.kernels.numerics.mat3 import Mat3
from softfinger.proxy.kernels.query.world import place_all
from softfinger.proxy.kernels.step import step_finger, step_once
from softfinger.proxy.record import FREE

MAX_RIGID_STEPS = 8
"""Largest number of rigid steps of a finger in a tick."""
SOLVED_ERROR_M = 1e-11
"""Error of the displacement, m, below which it is not corrected: 0.01 uN for a finger of 1000 N/m."""


@step_once.of(Elastic)
def step_on_elastic(elastic: Elastic, scene: Scene, state: State, poses: Any, dt: float) -> Any:
    """Compute one contact step of one or two fingers on the elastic object."""
    world = replace(state.world, "started", 1.0, "time", state.world.time + dt)
    objects = place_all(scene.objects, world)
    fingers, contacts, surfaces = press(scene.fingers, scene, objects, state, poses, dt)
    return State(world=replace(world, "surfaces", surfaces), fingers=fingers), contacts


@jit
def press(fingers: Any, scene: Scene, objects: Any, state: State, poses: Any, dt: float) -> Any:
    """Return FingerState, Contact and Surface of each finger."""
    if len(fingers) == 1:
        return press_one(fingers, scene, objects, state, poses, dt)
    return press_two(fingers, scene, objects, state, poses, dt)


@jit
def press_one(fingers: Any, scene: Scene, objects: Any, state: State, poses: Any, dt: float) -> Any:
    elastic, body, last, finger = scene.elastic, objects.body, state.world.surfaces[0], fingers[0]
    gain = compute_gain(elastic, dt)
    motion, drive = compute_drive(body, last, state.fingers[0], poses[0], gain)
    inverse = last.inverse[0]
    largest = vec3.norm(motion) + vec3.norm(last.change)
    u = predict_displacement(last, vec3.sub(motion, mat3.times(inverse, drive)), largest)
    retained = vec3.scale(1.0 - gain, last.displacement)
    before = move_into_surface(body, state.fingers[0], last.displacement)
    least, best = inf, u
    for rounds_left in range(MAX_RIGID_STEPS - 1, -1, -1):
        after, contact = step_finger(finger, before, shift_pose(body, poses[0], u), scene, objects, dt)
        spot = make_empty_spot()
        if contact.mode != FREE:
            spot = make_contact_spot(elastic, body, finger, before, after, contact, dt)
        rows = compute_node_rows(elastic, spot, spot)
        goal = vec3.add_scaled(retained, gain, mat3.times(read_compliance(spot, rows), spot.load))
        error = vec3.sub(goal, u)
        square = vec3.dot(error, error)
        if rounds_left == 0 or square <= SOLVED_ERROR_M**2:
            break
        if square < least:
            least, best = square, u
        if rounds_left == 1 and not square <= CORRECTION_ERROR_M**2:  # also NaN
            u = best
            continue
        spot, added = stick_if_reversed(spot, error)
        error = vec3.add_scaled(error, gain, mat3.times(read_compliance(spot, rows), added))
        moves = mat3.plus(compute_slope(spot, spot, rows), 1.0, compute_slope_by(spot, spot, rows, rows))
        inverse = mat3.inverse(mat3.plus(mat3.IDENTITY, gain, moves))
        u = vec3.add(u, mat3.times(inverse, error))
    slope = ZERO
    # The slope is that of the surface without damping: otherwise slow cycles would generate energy.
    if body.material.friction is None:
        gradient = compute_slope(spot, spot, rows)
        matrix = mat3.plus(mat3.plus(mat3.IDENTITY, 1.0, gradient), 1.0, compute_slope_by(spot, spot, rows, rows))
        slope = mat3.times(mat3.inverse(mat3.transpose(matrix)), mat3.times(mat3.transpose(gradient), spot.load))
    surface = update_surface(scene, finger, last, u, contact, (*find_bending(elastic, spot), square), dt)
    surface = replace(surface, "inverse", (mat3.IDENTITY if contact.mode == FREE else inverse,))
    return (place_probe(after, poses[0]),), (report_surface(body, contact, surface, slope),), (surface,)


@jit
def displace_both(compliances: tuple[Mat3, Mat3, Mat3], load_x: Vec3, load_y: Vec3) -> tuple[Vec3, Vec3]:
    """Return the displacements (3,) m of two spots under their loads (3,) N.

    compliances  of the spot x, between the two, and of y, m/N
    """
    of_x, between, of_y = compliances
    u = vec3.add(mat3.times(of_x, load_x), mat3.times(between, load_y))
    return u, vec3.add(mat3.times(mat3.transpose(between), load_x), mat3.times(of_y, load_y))


@jit
def press_two(fingers: Any, scene: Scene, objects: Any, state: State, poses: Any, dt: float) -> Any:
    elastic, body, last = scene.elastic, objects.body, state.world.surfaces
    gain = compute_gain(elastic, dt)
    retained_u, retained_v = vec3.scale(1.0 - gain, last[0].displacement), vec3.scale(1.0 - gain, last[1].displacement)
    motion_u, drive_u = compute_drive(body, last[0], state.fingers[0], poses[0], gain)
    motion_v, drive_v = compute_drive(body, last[1], state.fingers[1], poses[1], gain)
    inverse = (last[0].inverse, last[1].inverse)
    left_u, left_v = multiply_both(inverse, drive_u, drive_v)
    largest = vec3.norm(motion_u) + vec3.norm(motion_v) + vec3.norm(last[0].change) + vec3.norm(last[1].change)
    u = predict_displacement(last[0], vec3.sub(motion_u, left_u), largest)
    v = predict_displacement(last[1], vec3.sub(motion_v, left_v), largest)
    before_one = move_into_surface(body, state.fingers[0], last[0].displacement)
    before_two = move_into_surface(body, state.fingers[1], last[1].displacement)
    x, y = make_empty_spot(), make_empty_spot()
    least, best = inf, (u, v)
    for rounds_left in range(MAX_RIGID_STEPS - 1, -1, -1):
        after_one, first = step_finger(fingers[0], before_one, shift_pose(body, poses[0], u), scene, objects, dt)
        after_two, second = step_finger(fingers[1], before_two, shift_pose(body, poses[1], v), scene, objects, dt)
        is_loaded = first.mode != FREE or second.mode != FREE
        if is_loaded:
            x = find_spot(elastic, objects, fingers[0], before_one, after_one, first, x, dt)
            y = find_spot(elastic, objects, fingers[1], before_two, after_two, second, y, dt)
        else:
            x, y = make_empty_spot(), make_empty_spot()
        rows = compute_node_rows(elastic, x, x), compute_node_rows(elastic, x, y), compute_node_rows(elastic, y, y)
        compliances = read_compliance(x, rows[0]), read_compliance(x, rows[1]), read_compliance(y, rows[2])
        goal_u, goal_v = displace_both(compliances, x.load, y.load)
        error_u = vec3.sub(vec3.add_scaled(retained_u, gain, goal_u), u)
        error_v = vec3.sub(vec3.add_scaled(retained_v, gain, goal_v), v)
        square = vec3.dot(error_u, error_u) + vec3.dot(error_v, error_v)
        if rounds_left == 0 or square <= SOLVED_ERROR_M**2:
            break
        if square < least:
            least, best = square, (u, v)
        if rounds_left == 1 and not square <= CORRECTION_ERROR_M**2:  # also NaN
            u, v = best
            continue
        held_x, added_x = stick_if_reversed(x, error_u)
        held_y, added_y = stick_if_reversed(y, error_v)
        more_u, more_v = displace_both(compliances, added_x, added_y)
        error_u, error_v = vec3.add_scaled(error_u, gain, more_u), vec3.add_scaled(error_v, gain, more_v)
        (a, b, c, d), _ = linearize_both(elastic, held_x, held_y, rows, gain)
        inverse = invert_both(a, b, c, d)
        change_u, change_v = multiply_both(inverse, error_u, error_v)
        u, v = vec3.add(u, change_u), vec3.add(v, change_v)
    slope_u, slope_v = ZERO, ZERO
    if body.material.friction is None:  # as for one finger
        (a, b, c, d), gradients = linearize_both(elastic, x, y, rows, 1.0)
        (a, b), (c, d) = invert_both(a, b, c, d)
        transposed = (mat3.transpose(a), mat3.transpose(c)), (mat3.transpose(b), mat3.transpose(d))
        slope_u, slope_v = multiply_both(transposed, gradients[0], gradients[1])
    bent_x, bent_y = find_bending(elastic, x), find_bending(elastic, y)
    measures = (bent_x[0] + bent_y[0], bent_x[1] + bent_y[1], square)
    surface_u = update_surface(scene, fingers[0], last[0], u, first, measures, dt)
    surface_v = update_surface(scene, fingers[1], last[1], v, second, measures, dt)
    if not is_loaded:
        inverse = ((mat3.IDENTITY, mat3.ZEROS), (mat3.ZEROS, mat3.IDENTITY))
    surface_u, surface_v = replace(surface_u, "inverse", inverse[0]), replace(surface_v, "inverse", inverse[1])
    contacts = (report_surface(body, first, surface_u, slope_u), report_surface(body, second, surface_v, slope_v))
    return (place_probe(after_one, poses[0]), place_probe(after_two, poses[1])), contacts, (surface_u, surface_v)
