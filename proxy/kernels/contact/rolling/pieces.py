"""Rolling in closed form over shapes made of several surfaces, one piece of the path after the other.

A piece ends at a limit of a coordinate of the contact point or of a component of the normal. Each of these is a
constant plus a sine and a cosine of one frequency (a parabola at frequency 0). So the end is a root of a quadratic
equation, and the path is exact across faces, edges and corners.
"""

from math import atan, pi, sqrt

from softfinger.proxy.kernels.contact.rolling.base import Roll, land
from softfinger.proxy.kernels.contact.rolling.closed import compute_turning_share, roll_over_cylinder, roll_over_sphere
from softfinger.proxy.kernels.contact.rolling.integrated import integrate
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Box, CappedCylinder, Capsule, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.shapes import transport, unroll
from softfinger.proxy.kernels.shapes.protocol import compute_direction

ToRim = tuple[float, Vec3, Vec3, float]

MAX_PIECES = 256
"""Largest number of pieces in a tick; the remaining rotation is ignored. Half a turn over a box has at most nine.
More are possible only in a hollow capsule that is hardly wider than the fingertip: the path winds round it."""
RIM_TOLERANCE = 1e-13
"""Tolerance of the integration around the rim of a capped cylinder, as a share of the fingertip's radius."""
NEVER = 2.0
"""Time after the end of the tick, which is at 1."""


@jit
def compute_leaving_time(value: float, slope: float, bend: float, frequency: float) -> float:
    """Return the first time at which f falls below 0, or NEVER.

    value, slope, bend   f, f' and f'' at time 0, with f >= 0 up to rounding
    frequency            of f: f''' = -frequency^2 f'

    As a function of T = tan(frequency t / 2) / (frequency / 2), which is t at frequency 0, f has the sign of
    a T^2 + slope T + value; f decreases at only one of the two roots.
    """
    c = max(value, 0.0)
    a = 0.25 * (frequency * frequency * c + 2.0 * bend)
    discriminant = slope * slope - 4.0 * a * c
    if discriminant < 0.0:
        return NEVER
    root = sqrt(discriminant)
    if slope <= 0.0:
        if root - slope > 0.0:
            t = 2.0 * c / (root - slope)
        else:
            return 0.0 if a < 0.0 else NEVER
    else:
        if a == 0.0:
            return NEVER
        t = -0.5 * (slope + root) / a
    if frequency == 0.0:
        return t if t >= 0.0 else NEVER
    time = 2.0 * atan(0.5 * frequency * t) / frequency
    # Second branch of the tangent: the second half of the period.
    return time if time >= 0.0 else time + 2.0 * pi / frequency


@jit
def with_item(v: Vec3, index: int, value: float) -> Vec3:
    """Return `v` with one component replaced."""
    return (
        value if index == 0 else v[0],
        value if index == 1 else v[1],
        value if index == 2 else v[2],
    )


@jit
def compute_barrel_exit(
    half_length: float, z: float, share: float, radius: float, normal: Vec3, w: Vec3
) -> tuple[float, float]:
    """Return the time at which a path over a barrel about the z axis reaches an end, and the end: +1 or -1 along z."""
    slope = radius * vec3.cross(w, normal)[2]
    bend = radius * share * vec3.cross(w, vec3.cross((0.0, 0.0, w[2]), normal))[2]
    frequency = abs(share * w[2])
    up = compute_leaving_time(half_length - z, -slope, -bend, frequency)
    down = compute_leaving_time(half_length + z, slope, bend, frequency)
    return (up, 1.0) if up < down else (down, -1.0)


@unroll.of(Capsule)
def unroll_on_capsule(shape: Capsule, radius: float, center: Vec3, normal: Vec3, w: Vec3) -> Roll:
    """Roll over barrel (a cylinder) and caps (spheres), from outside or inside."""
    axis, distance = (0.0, 0.0, 1.0), radius + shape.side * shape.radius
    share, outward = compute_turning_share(radius, distance), 1.0 if distance >= 0.0 else -1.0
    beyond = abs(center[2]) - shape.half_length
    cap = 0.0 if beyond <= 0.0 else (1.0 if center[2] > 0.0 else -1.0)
    z, n = min(max(center[2], -shape.half_length), shape.half_length), normal
    if cap == 0.0:
        _, n = compute_direction((n[0], n[1], 0.0), normal)
    motion, spin, remaining = (0.0, 0.0, 0.0), 0.0, 1.0
    for _ in range(MAX_PIECES):
        time, to = 0.0, 0.0
        if cap == 0.0:
            time, to = compute_barrel_exit(shape.half_length, z, share, radius, n, w)
        else:
            sign, turning = cap * outward, vec3.cross(w, n)
            bend = share * share * vec3.cross(w, turning)[2]
            time = compute_leaving_time(sign * n[2], sign * share * turning[2], sign * bend, abs(share) * vec3.norm(w))
        part = vec3.scale(min(time, remaining), w)
        before = n
        if cap == 0.0:
            n, moved, twist = roll_over_cylinder(radius, share, axis, n, part)
            z = min(max(z + moved[2], -shape.half_length), shape.half_length)
        else:
            n, moved, twist = roll_over_sphere(radius, share, n, part)
        motion, spin = vec3.add(transport(shape, motion, before, n), moved), spin + twist
        if time >= remaining:
            break
        remaining -= time
        z, cap = (to * shape.half_length, to) if cap == 0.0 else (z, 0.0)
        _, n = compute_direction((n[0], n[1], 0.0), n)
    end = vec3.add_scaled((0.0, 0.0, cap * shape.half_length if cap != 0.0 else z), distance, n)
    center, n = land(shape, radius, end)
    return Roll(center, n, motion, vec3.norm(motion) / radius, spin, True)


@jit
def find_end_of_box_piece(
    half_extents: Vec3, radius: float, point: Vec3, sides: Vec3, normal: Vec3, w: Vec3
) -> tuple[float, int, float]:
    """Return the time at which a path over a box leaves its face, edge or corner, the axis, and the new side on it.

    sides  (3,)  1  for each axis: +1 or -1 if the contact is at that end of the box, 0 if it is between the ends
    """
    clamped = abs(sides[0]) + abs(sides[1]) + abs(sides[2])
    pivot = (0.0, 0.0, 0.0)
    if clamped > 2.5:
        pivot = w
    elif clamped > 1.5:
        free = (1.0 - abs(sides[0]), 1.0 - abs(sides[1]), 1.0 - abs(sides[2]))
        pivot = (free[0] * w[0], free[1] * w[1], free[2] * w[2])
    frequency = vec3.norm(pivot)
    turning = vec3.cross(pivot, normal)
    turning_bend = vec3.cross(pivot, turning)
    slope, bend = vec3.scale(radius, vec3.cross(w, normal)), vec3.scale(radius, vec3.cross(w, turning))
    time, axis, side = NEVER, 0, 0.0
    for i in range(3):
        if sides[i] != 0.0:
            t = compute_leaving_time(sides[i] * normal[i], sides[i] * turning[i], sides[i] * turning_bend[i], frequency)
            if t < time and clamped > 1.5:
                time, axis, side = t, i, 0.0
        else:
            for end in (-1.0, 1.0):
                t = compute_leaving_time(half_extents[i] - end * point[i], -end * slope[i], -end * bend[i], frequency)
                if t < time:
                    time, axis, side = t, i, end
    return time, axis, side


@unroll.of(Box)
def unroll_on_box(shape: Box, radius: float, center: Vec3, normal: Vec3, w: Vec3) -> Roll:
    """Roll over faces (planes), edges (cylinders of radius 0) and corners (spheres of radius 0)."""
    h = shape.half_extents
    point = (
        min(max(center[0], -h[0]), h[0]),
        min(max(center[1], -h[1]), h[1]),
        min(max(center[2], -h[2]), h[2]),
    )
    _, n = compute_direction(vec3.sub(center, point), normal)
    sides = (
        1.0 if n[0] > 0.0 else (-1.0 if n[0] < 0.0 else 0.0),
        1.0 if n[1] > 0.0 else (-1.0 if n[1] < 0.0 else 0.0),
        1.0 if n[2] > 0.0 else (-1.0 if n[2] < 0.0 else 0.0),
    )
    motion, spin, remaining = (0.0, 0.0, 0.0), 0.0, 1.0
    for _ in range(MAX_PIECES):
        time, axis, side = find_end_of_box_piece(h, radius, point, sides, n, w)
        part = vec3.scale(min(time, remaining), w)
        clamped = abs(sides[0]) + abs(sides[1]) + abs(sides[2])
        before = n
        if clamped > 2.5:
            n, moved, twist = roll_over_sphere(radius, 1.0, n, part)
        elif clamped > 1.5:
            along = (1.0 - abs(sides[0]), 1.0 - abs(sides[1]), 1.0 - abs(sides[2]))
            n, moved, twist = roll_over_cylinder(radius, 1.0, along, n, part)
            point = vec3.add_scaled(point, vec3.dot(moved, along), along)
        else:
            moved, twist = vec3.scale(radius, vec3.cross(part, n)), vec3.dot(part, n)
            point = vec3.add(point, moved)
        motion, spin = vec3.add(transport(shape, motion, before, n), moved), spin + twist
        if time >= remaining:
            break
        remaining -= time
        if side == 0.0:
            _, n = compute_direction(with_item(n, axis, 0.0), n)
        else:
            point = with_item(point, axis, side * h[axis])
        sides = with_item(sides, axis, side)
    center, n = land(shape, radius, vec3.add_scaled(point, radius, n))
    return Roll(center, n, motion, vec3.norm(motion) / radius, spin, True)


@jit
def roll_to_rim_over_barrel(shape: CappedCylinder, radius: float, center: Vec3, normal: Vec3, w: Vec3) -> ToRim:
    """Return the share of the tick, at most 1, until a path on the barrel is at the rim; centre, motion, spin there."""
    distance, (_, n) = radius + shape.radius, compute_direction((normal[0], normal[1], 0.0), normal)
    share = compute_turning_share(radius, distance)
    time = min(compute_barrel_exit(shape.half_length, center[2], share, radius, n, w)[0], 1.0)
    n, motion, spin = roll_over_cylinder(radius, share, (0.0, 0.0, 1.0), n, vec3.scale(time, w))
    return time, (distance * n[0], distance * n[1], center[2] + motion[2]), motion, spin


@jit
def roll_to_rim_over_end(shape: CappedCylinder, radius: float, center: Vec3, normal: Vec3, w: Vec3) -> ToRim:
    """Return the same on a flat end: the squared distance from the axis is a parabola."""
    velocity = vec3.scale(radius, vec3.cross(w, normal))
    room = shape.radius * shape.radius - center[0] * center[0] - center[1] * center[1]
    closing = -2.0 * (center[0] * velocity[0] + center[1] * velocity[1])
    time = min(compute_leaving_time(room, closing, -2.0 * vec3.dot(velocity, velocity), 0.0), 1.0)
    motion = vec3.scale(time, velocity)
    return time, vec3.add(center, motion), motion, time * vec3.dot(w, normal)


@unroll.of(CappedCylinder)
def unroll_on_capped_cylinder(shape: CappedCylinder, radius: float, center: Vec3, normal: Vec3, w: Vec3) -> Roll:
    """Roll over barrel (a cylinder) and flat ends (planes) in closed form; from the rim on, by integration."""
    over_barrel = abs(center[2]) <= shape.half_length
    over_end = center[0] * center[0] + center[1] * center[1] <= shape.radius * shape.radius
    if over_barrel == over_end:  # neither: on the rim; both: inside the solid
        return integrate(shape, radius, center, normal, w, RIM_TOLERANCE)
    if over_barrel:
        time, end, motion, spin = roll_to_rim_over_barrel(shape, radius, center, normal, w)
    else:
        time, end, motion, spin = roll_to_rim_over_end(shape, radius, center, normal, w)
    center, n = land(shape, radius, end)
    if time >= 1.0:
        return Roll(center, n, motion, vec3.norm(motion) / radius, spin, True)
    remainder = integrate(shape, radius, center, n, vec3.scale(1.0 - time, w), RIM_TOLERANCE)
    motion = vec3.add(transport(shape, motion, n, remainder.normal), remainder.motion)
    return Roll(remainder.center, remainder.normal, motion, vec3.norm(motion) / radius, spin + remainder.spin, True)
