"""Rolling in closed form over shapes made of several surfaces, one piece of path after the other.

On each piece everything that decides where it ends, a coordinate of the contact point or a component
of the normal, is a constant plus a sine and a cosine of one frequency (a parabola at frequency 0). So
the end is a root of a quadratic, and the path is exact across faces, edges and corners.
"""

from math import atan, pi, sqrt

from softfinger.proxy.kernels import vec3
from softfinger.proxy.kernels.jit import jit
from softfinger.proxy.kernels.model import Box, CappedCylinder, Capsule, Vec3
from softfinger.proxy.kernels.rolling.base import Roll, land
from softfinger.proxy.kernels.rolling.closed import over_cylinder, over_sphere, turning_share, unroll
from softfinger.proxy.kernels.rolling.integrated import integrate
from softfinger.proxy.kernels.surfaces import transport

MAX_PIECES = 32
"""Pieces of path in one tick. Half a turn over the smallest box crosses about six; a hollow capsule much
narrower than its fingertip can ask for more, and what is then left of the tick is not rolled."""
RIM_TOLERANCE = 1e-13
"""Of the integration around the rim of a capped cylinder, relative to the fingertip's radius."""
NEVER = 2.0
"""A time after the end of the tick, which is at 1."""


@jit
def leaving_time(value: float, slope: float, bend: float, frequency: float) -> float:
    """First time at which f falls through 0; NEVER where it does not.

    value, slope, bend   f, f' and f'' at time 0, where f >= 0 up to rounding
    frequency            of f: f''' = -frequency^2 f'

    In T = tan(frequency t / 2) / (frequency / 2), which is t at frequency 0, f has the sign of
    a T^2 + slope T + value, and of the two roots only one is a fall.
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
    # The tangent's other branch: the second half of the period.
    return time if time >= 0.0 else time + 2.0 * pi / frequency


@jit
def with_item(v: Vec3, index: int, value: float) -> Vec3:
    """`v` with one component replaced."""
    return (
        value if index == 0 else v[0],
        value if index == 1 else v[1],
        value if index == 2 else v[2],
    )


@jit
def unit(v: Vec3, otherwise: Vec3) -> Vec3:
    size = vec3.norm(v)
    return vec3.scale(1.0 / size, v) if size > 0.0 else otherwise


@unroll.of(Capsule)
def unroll_on_capsule(shape: Capsule, radius: float, center: Vec3, normal: Vec3, w: Vec3) -> Roll:
    """Barrel (a cylinder) and caps (spheres), touched from outside or inside."""
    axis, distance = (0.0, 0.0, 1.0), radius + shape.side * shape.radius
    share, outward = turning_share(radius, distance), 1.0 if distance >= 0.0 else -1.0
    beyond = abs(center[2]) - shape.half_length
    cap = 0.0 if beyond <= 0.0 else (1.0 if center[2] > 0.0 else -1.0)
    z, n = min(max(center[2], -shape.half_length), shape.half_length), normal
    if cap == 0.0:
        n = unit((n[0], n[1], 0.0), normal)
    motion, spin, left = (0.0, 0.0, 0.0), 0.0, 1.0
    for _ in range(MAX_PIECES):
        slope = vec3.cross(w, n)
        pivot = w if cap != 0.0 else (0.0, 0.0, w[2])
        bend = vec3.cross(w, vec3.scale(share, vec3.cross(pivot, n)))
        frequency = abs(share) * vec3.norm(pivot)
        time, to = NEVER, 0.0
        if cap == 0.0:
            up = leaving_time(shape.half_length - z, -radius * slope[2], -radius * bend[2], frequency)
            down = leaving_time(shape.half_length + z, radius * slope[2], radius * bend[2], frequency)
            time, to = (up, 1.0) if up < down else (down, -1.0)
        else:
            sign = cap * outward
            time = leaving_time(sign * n[2], sign * share * slope[2], sign * share * bend[2], frequency)
        part = vec3.scale(min(time, left), w)
        before = n
        if cap == 0.0:
            n, moved, twist = over_cylinder(radius, share, axis, n, part)
            z = min(max(z + moved[2], -shape.half_length), shape.half_length)
        else:
            n, moved, twist = over_sphere(radius, share, n, part)
        motion, spin = vec3.add(transport(shape, motion, before, n), moved), spin + twist
        if time >= left:
            break
        left -= time
        z, cap = (to * shape.half_length, to) if cap == 0.0 else (z, 0.0)
        n = unit((n[0], n[1], 0.0), n)
    end = vec3.add_scaled((0.0, 0.0, cap * shape.half_length if cap != 0.0 else z), distance, n)
    center, n = land(shape, radius, end)
    return Roll(center, n, motion, vec3.norm(motion) / radius, spin)


@jit
def box_pieces(
    half_extents: Vec3, radius: float, point: Vec3, sides: Vec3, normal: Vec3, w: Vec3
) -> tuple[float, int, float]:
    """When a path over a box leaves its face, edge or corner: time, the axis concerned and that axis' new side.

    sides  (3,)  1  for each axis: +-1 where the contact is at that end of the box, 0 where it is between
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
            t = leaving_time(sides[i] * normal[i], sides[i] * turning[i], sides[i] * turning_bend[i], frequency)
            if t < time and clamped > 1.5:
                time, axis, side = t, i, 0.0
        else:
            for end in (-1.0, 1.0):
                t = leaving_time(half_extents[i] - end * point[i], -end * slope[i], -end * bend[i], frequency)
                if t < time:
                    time, axis, side = t, i, end
    return time, axis, side


@unroll.of(Box)
def unroll_on_box(shape: Box, radius: float, center: Vec3, normal: Vec3, w: Vec3) -> Roll:
    """Faces (planes), edges (cylinders of radius 0) and corners (spheres of radius 0)."""
    h = shape.half_extents
    point = (
        min(max(center[0], -h[0]), h[0]),
        min(max(center[1], -h[1]), h[1]),
        min(max(center[2], -h[2]), h[2]),
    )
    n = unit(vec3.sub(center, point), normal)
    sides = (
        1.0 if n[0] > 0.0 else (-1.0 if n[0] < 0.0 else 0.0),
        1.0 if n[1] > 0.0 else (-1.0 if n[1] < 0.0 else 0.0),
        1.0 if n[2] > 0.0 else (-1.0 if n[2] < 0.0 else 0.0),
    )
    motion, spin, left = (0.0, 0.0, 0.0), 0.0, 1.0
    for _ in range(MAX_PIECES):
        time, axis, side = box_pieces(h, radius, point, sides, n, w)
        part = vec3.scale(min(time, left), w)
        clamped = abs(sides[0]) + abs(sides[1]) + abs(sides[2])
        before = n
        if clamped > 2.5:
            n, moved, twist = over_sphere(radius, 1.0, n, part)
        elif clamped > 1.5:
            along = (1.0 - abs(sides[0]), 1.0 - abs(sides[1]), 1.0 - abs(sides[2]))
            n, moved, twist = over_cylinder(radius, 1.0, along, n, part)
            point = vec3.add_scaled(point, vec3.dot(moved, along), along)
        else:
            moved, twist = vec3.scale(radius, vec3.cross(part, n)), vec3.dot(part, n)
            point = vec3.add(point, moved)
        motion, spin = vec3.add(transport(shape, motion, before, n), moved), spin + twist
        if time >= left:
            break
        left -= time
        if side == 0.0:
            n = unit(with_item(n, axis, 0.0), n)
        else:
            point = with_item(point, axis, side * h[axis])
        sides = with_item(sides, axis, side)
    center, n = land(shape, radius, vec3.add_scaled(point, radius, n))
    return Roll(center, n, motion, vec3.norm(motion) / radius, spin)


@unroll.of(CappedCylinder)
def unroll_on_capped_cylinder(shape: CappedCylinder, radius: float, center: Vec3, normal: Vec3, w: Vec3) -> Roll:
    """Barrel (a cylinder) and flat caps (planes) in closed form; from the rim on, which has none, integrated."""
    distance = radius + shape.radius
    on_barrel = abs(center[2]) <= shape.half_length
    outside = center[0] * center[0] + center[1] * center[1] > shape.radius * shape.radius
    if on_barrel == outside:
        if on_barrel:
            n = unit((normal[0], normal[1], 0.0), normal)
            share = turning_share(radius, distance)
            slope, pivot = vec3.cross(w, n), (0.0, 0.0, w[2])
            bend = vec3.cross(w, vec3.scale(share, vec3.cross(pivot, n)))
            frequency = share * abs(w[2])
            up = leaving_time(shape.half_length - center[2], -radius * slope[2], -radius * bend[2], frequency)
            down = leaving_time(shape.half_length + center[2], radius * slope[2], radius * bend[2], frequency)
            time = min(up, down, 1.0)
            n, motion, spin = over_cylinder(radius, share, (0.0, 0.0, 1.0), n, vec3.scale(time, w))
            end = (distance * n[0], distance * n[1], center[2] + motion[2])
        else:
            velocity = vec3.scale(radius, vec3.cross(w, normal))
            inside = shape.radius * shape.radius - center[0] * center[0] - center[1] * center[1]
            closing = -2.0 * (center[0] * velocity[0] + center[1] * velocity[1])
            time = min(leaving_time(inside, closing, -2.0 * vec3.dot(velocity, velocity), 0.0), 1.0)
            motion, spin = vec3.scale(time, velocity), time * vec3.dot(w, normal)
            end = vec3.add(center, motion)
        center, n = land(shape, radius, end)
        if time >= 1.0:
            return Roll(center, n, motion, vec3.norm(motion) / radius, spin)
        rest = integrate(shape, radius, center, n, vec3.scale(1.0 - time, w), RIM_TOLERANCE)
        motion = vec3.add(transport(shape, motion, n, rest.normal), rest.motion)
        return Roll(rest.center, rest.normal, motion, vec3.norm(motion) / radius, spin + rest.spin)
    return integrate(shape, radius, center, normal, w, RIM_TOLERANCE)
