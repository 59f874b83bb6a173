"""Rolling by numerical integration of dc/dt = r w x n(c), w constant over the tick, on any shape.

n(c) is the normal at the point of the object nearest to c. It is also defined off the offset surface, where the
intermediate stages of a step are. The curvature is not needed: the change of n along the path includes it.
"""

from typing import Any

import numba

from softfinger.proxy.kernels.contact.rolling.base import (
    Roll,
    compute_center_velocity,
    compute_roll_angle,
    measure_surface_part,
    rewind_shape,
    roll,
)
from softfinger.proxy.kernels.jit.decorators import OPTIONS, jit
from softfinger.proxy.kernels.model import Midpoint, MontanaRk4, MontanaRk45, Quaternion, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.shapes import BUDGET_OF_A_ROLL, closest_from, transport

MAX_TRIALS = 256
"""Largest number of trial sub-steps in a tick, in the method with step control."""


@jit
def unroll_displacement(step: Vec3, normal: Vec3, length: float) -> Vec3:
    """Project the path `step` (3,) m of a step into the tangent plane at its end, and scale it to `length` m."""
    tangential = vec3.reject(step, normal)
    size = vec3.norm(tangential)
    return vec3.scale(length / size if size > 0.0 else 0.0, tangential)


@jit
def integrate_by_midpoint(shape: Any, radius: float, center: Vec3, normal: Vec3, w: Vec3) -> Roll:
    """Roll by the rotation vector `w` with the midpoint rule: second order, two queries of the closest point."""
    point, n, slope = center, normal, (0.0, 0.0, 0.0)
    start_point = vec3.add_scaled(center, -radius, normal)
    spin = 0.0
    length, tilted = 0.0, 0.0
    for stage in range(2):
        part = 0.5 if stage == 0 else 1.0
        slope, spin = compute_center_velocity(rewind_shape(shape, w, 1.5 - part), radius, w, n), vec3.dot(w, n)
        length, tilted = measure_surface_part(shape, slope, n), vec3.norm(vec3.cross(w, n))
        moving_shape = rewind_shape(shape, w, 1.0 - part)
        _, point, n, _ = closest_from(moving_shape, vec3.add_scaled(center, part, slope), start_point, BUDGET_OF_A_ROLL)
    end = vec3.add_scaled(point, radius, n)
    motion = unroll_displacement(slope, n, length)
    return Roll(end, n, motion, compute_roll_angle(shape, radius, motion, tilted), spin, True)


@roll.of(Midpoint)
def roll_midpoint(method: Midpoint, shape: Any, radius: float, center: Vec3, normal: Vec3, turn: Quaternion) -> Roll:
    return integrate_by_midpoint(shape, radius, center, normal, rotations.log(turn))


@roll.of(MontanaRk4)
def roll_montana_rk4(
    method: MontanaRk4, shape: Any, radius: float, center: Vec3, normal: Vec3, turn: Quaternion
) -> Roll:
    """Roll by one step of the classical Runge-Kutta rule: fourth order, four queries of the closest point."""
    w = rotations.log(turn)
    point, n, moved = center, normal, (0.0, 0.0, 0.0)
    start_point = vec3.add_scaled(center, -radius, normal)
    spin, length, tilted, remaining = 0.0, 0.0, 0.0, 1.0
    # A loop instead of four explicit stages: the query of the closest point is compiled only once.
    for stage in range(4):
        weight = 1.0 / 6.0 if stage == 0 or stage == 3 else 1.0 / 3.0
        slope = compute_center_velocity(rewind_shape(shape, w, remaining), radius, w, n)
        moved = vec3.add_scaled(moved, weight, slope)
        spin += weight * vec3.dot(w, n)
        length += weight * measure_surface_part(shape, slope, n)
        tilted += weight * vec3.norm(vec3.cross(w, n))
        ahead = moved if stage == 3 else vec3.scale(1.0 if stage == 2 else 0.5, slope)
        remaining = 0.5 if stage < 2 else 0.0
        _, point, n, _ = closest_from(
            rewind_shape(shape, w, remaining), vec3.add(center, ahead), start_point, BUDGET_OF_A_ROLL
        )
    end = vec3.add_scaled(point, radius, n)
    motion = unroll_displacement(moved, n, length)
    return Roll(end, n, motion, compute_roll_angle(shape, radius, motion, tilted), spin, True)


def find_foot(shape: Any, x: Vec3, start: Vec3, budget: int) -> tuple[Vec3, Vec3, int]:
    _, point, normal, budget = closest_from(shape, x, start, budget)
    return point, normal, budget


# Not inlined, unlike other kernels: six copies of an iterative query would take seconds to compile.
find_foot = numba.njit(**OPTIONS)(find_foot)


@jit
def combine(a: float, u: Vec3, b: float, v: Vec3) -> Vec3:
    """Return a u + b v."""
    return (a * u[0] + b * v[0], a * u[1] + b * v[1], a * u[2] + b * v[2])


@jit
def compute_mean_rates(shape: Any, w: Vec3, k: Any, n: Any) -> tuple[float, float, float]:
    """Return the mean rates in a sub-step of the contact's motion on the surface, m, of spin and of tilt, rad.

    Each is the sum of the fifth-order rule, from the velocities `k` and normals `n` at its stages 1, 3, 4, 5 and 6. The
    unit of time is the tick.
    """
    length = (
        35 / 384 * measure_surface_part(shape, k[0], n[0]) + 500 / 1113 * measure_surface_part(shape, k[1], n[1])
        + 125 / 192 * measure_surface_part(shape, k[2], n[2]) - 2187 / 6784 * measure_surface_part(shape, k[3], n[3])
        + 11 / 84 * measure_surface_part(shape, k[4], n[4])
    )  # fmt: skip
    spin = (
        35 / 384 * vec3.dot(w, n[0]) + 500 / 1113 * vec3.dot(w, n[1]) + 125 / 192 * vec3.dot(w, n[2])
        - 2187 / 6784 * vec3.dot(w, n[3]) + 11 / 84 * vec3.dot(w, n[4])
    )  # fmt: skip
    tilt = (
        35 / 384 * vec3.norm(vec3.cross(w, n[0])) + 500 / 1113 * vec3.norm(vec3.cross(w, n[1]))
        + 125 / 192 * vec3.norm(vec3.cross(w, n[2])) - 2187 / 6784 * vec3.norm(vec3.cross(w, n[3]))
        + 11 / 84 * vec3.norm(vec3.cross(w, n[4]))
    )  # fmt: skip
    return length, spin, tilt


@jit
def integrate(shape: Any, radius: float, center: Vec3, normal: Vec3, w: Vec3, tolerance: float) -> Roll:
    """Roll by the rotation vector `w` with the Dormand-Prince pair: order 5, with an error estimate of order 4.

    A sub-step is accepted if its error is at most tolerance x radius, otherwise repeated with a shorter one, much
    shorter at a jump of the curvature. The number of trials is bounded: after half of them, a sub-step has at least the
    remaining time divided by the remaining trials, and at this length it is accepted with any error. On a shape whose
    queries have a budget, the integration may end early (`Roll.is_complete`).
    """
    n, motion, spin, tilted, remaining, h = normal, (0.0, 0.0, 0.0), 0.0, 0.0, 1.0, 1.0
    allowed, budget = tolerance * radius, BUDGET_OF_A_ROLL
    k1 = compute_center_velocity(rewind_shape(shape, w, 1.0), radius, w, n)
    for trial in range(MAX_TRIALS):
        start_point = vec3.add_scaled(center, -radius, n)
        shortest = remaining / (MAX_TRIALS - trial) if trial >= MAX_TRIALS // 2 else 0.0
        h = min(max(h, shortest), remaining)
        then = rewind_shape(shape, w, remaining - 1 / 5 * h)
        _, n2, budget = find_foot(then, vec3.add_scaled(center, h / 5, k1), start_point, budget)
        k2 = compute_center_velocity(then, radius, w, n2)
        slope = combine(3 / 40, k1, 9 / 40, k2)
        then = rewind_shape(shape, w, remaining - 3 / 10 * h)
        _, n3, budget = find_foot(then, vec3.add_scaled(center, h, slope), start_point, budget)
        k3 = compute_center_velocity(then, radius, w, n3)
        slope = vec3.add_scaled(combine(44 / 45, k1, -56 / 15, k2), 32 / 9, k3)
        then = rewind_shape(shape, w, remaining - 4 / 5 * h)
        _, n4, budget = find_foot(then, vec3.add_scaled(center, h, slope), start_point, budget)
        k4 = compute_center_velocity(then, radius, w, n4)
        slope = vec3.add(
            combine(19372 / 6561, k1, -25360 / 2187, k2), combine(64448 / 6561, k3, -212 / 729, k4)
        )  # fmt: skip
        then = rewind_shape(shape, w, remaining - 8 / 9 * h)
        _, n5, budget = find_foot(then, vec3.add_scaled(center, h, slope), start_point, budget)
        k5 = compute_center_velocity(then, radius, w, n5)
        slope = vec3.add(combine(9017 / 3168, k1, -355 / 33, k2), combine(46732 / 5247, k3, 49 / 176, k4))
        slope = vec3.add_scaled(slope, -5103 / 18656, k5)
        then = rewind_shape(shape, w, remaining - h)
        _, n6, budget = find_foot(then, vec3.add_scaled(center, h, slope), start_point, budget)
        k6 = compute_center_velocity(then, radius, w, n6)
        slope = vec3.add(combine(35 / 384, k1, 500 / 1113, k3), combine(125 / 192, k4, -2187 / 6784, k5))
        slope = vec3.add_scaled(slope, 11 / 84, k6)
        point, n7, budget = find_foot(then, vec3.add_scaled(center, h, slope), start_point, budget)
        k7 = compute_center_velocity(then, radius, w, n7)
        if budget < 0:
            break

        off = vec3.add(combine(71 / 57600, k1, -71 / 16695, k3), combine(71 / 1920, k4, -17253 / 339200, k5))
        off = vec3.add(off, combine(22 / 525, k6, -1 / 40, k7))
        error = h * vec3.norm(off)
        if error <= allowed or h <= shortest:
            end = vec3.add_scaled(point, radius, n7)
            length, rate, tilt = compute_mean_rates(shape, w, (k1, k3, k4, k5, k6), (n, n3, n4, n5, n6))
            spin, tilted = spin + h * rate, tilted + h * tilt
            motion = vec3.add(transport(shape, motion, n, n7), unroll_displacement(slope, n7, h * length))
            center, n, k1 = end, n7, k7
            remaining -= h
            if remaining <= 0.0:
                break
        # Error ~ h^5 for a fifth-order rule; a zero error, as on a plane, allows the longest step.
        h *= min(max(0.9 * (allowed / error) ** 0.2, 0.2), 5.0) if error > 0.0 else 5.0
    return Roll(center, n, motion, compute_roll_angle(shape, radius, motion, tilted), spin, budget >= 0)


@roll.of(MontanaRk45)
def roll_montana_rk45(
    method: MontanaRk45, shape: Any, radius: float, center: Vec3, normal: Vec3, turn: Quaternion
) -> Roll:
    """Roll as the paper's reference, ODE45: with as many sub-steps as the tolerance requires."""
    return integrate(shape, radius, center, normal, rotations.log(turn), method.tolerance)
