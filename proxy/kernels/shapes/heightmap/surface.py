"""Surface of a height map, z = h(x, y), with the solid below: h is a bicubic spline through the heights of a grid.

The spline is a uniform cubic B-spline that interpolates the heights: the only piecewise cubic with continuous first and
second derivatives. So normal and curvature are continuous, as rolling requires; a bilinear or Catmull-Rom surface would
jerk at each pixel. Beyond its rim the map levels off within three pixels, with continuous derivatives, and is flat
farther out.

Lengths in this module are in pitches, and (s, t) are the coordinates in cells from the corner of the grid. A foot point
of the point p is a local minimum of the distance, found by Newton's method on D(s, t) = |(s, t, h) - p|^2 / 2,

    g = (s - p_s + w h_s, t - p_t + w h_t),  H = 1 + h' h'^T + w h'',  w = h - p_z

which converges to rounding. Since the surface is a graph, H is positive definite everywhere if |w| is below the
smallest radius of curvature of any valley (for p below the surface: of any ridge). Then there is a single foot point,
the nearest point. Otherwise `nearest` searches for a closer one.
"""

from math import sqrt
from typing import NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Heightmap, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.numerics.scalars import Four, compute_spline_weights, weigh
from softfinger.proxy.kernels.shapes.protocol import (
    Z_AXIS,
    compute_direction,
    compute_offset_curvature,
    concavity,
    curvature,
)

MAX_NEWTON_STEPS = 24
"""Limit of Newton's steps; usually three to five, more only for a start far from any foot point."""
MAX_REDUCTIONS = 8
"""Limit of the reductions of a step to a quarter until the distance decreases; a smaller step is rounding."""
MAX_EVALUATIONS = 48
"""Limit of the height evaluations in the search of a foot point; usually about ten."""
CONVERGED_STEP = 1e-7
"""Step, in pitches, below which the next would be below rounding: the convergence is quadratic."""
UNCHECKED_STEP = 1e-3
"""Steps up to this length, in pitches, are accepted without a check of the distance: its rounding would hide the
decrease."""
MIN_SECOND_DERIVATIVE = 1e-3
"""Lower bound of the second derivative of D in a Newton step, 1 on a flat map."""
FOOT_SINE = 1e-6
"""Sine of the angle between normal and direction to p, above which a point is not a foot point (too few steps)."""


class Height(NamedTuple):
    """Height h at a position, and its derivatives, in pitches."""

    z: float
    s: float
    t: float
    ss: float
    st: float
    tt: float


class MapPoint(NamedTuple):
    s: float
    t: float


class MapFoot(NamedTuple):
    """Foot point (s, t), height and derivatives there, and the squared distance; all in pitches."""

    s: float
    t: float
    height: Height
    squared_distance: float


@jit
def clamp_to_cells(place: float, count: float) -> float:
    """Clamp a coordinate to its `count` cells; return 0 for NaN."""
    if not place > 0.0:
        return 0.0
    return min(place, count)


@jit
def read_row(shape: Heightmap, start: int, a: Four, da: Four, dda: Four) -> Vec3:
    """Return the weighted sum of four values in a row, from index `start`, and its first and second derivatives."""
    z = shape.coefficients
    z0, z1, z2, z3 = z[start], z[start + 1], z[start + 2], z[start + 3]
    return weigh(a, z0, z1, z2, z3), weigh(da, z0, z1, z2, z3), weigh(dda, z0, z1, z2, z3)


@jit
def compute_height(shape: Heightmap, s: float, t: float) -> Height:
    """Return height and derivatives at any position, outside of the map at the closest point of its border.

    The outermost cells are level at the border, so that the derivatives are continuous there.
    """
    s, t = clamp_to_cells(s, shape.columns), clamp_to_cells(t, shape.rows)
    i, j = min(int(s), int(shape.columns) - 1), min(int(t), int(shape.rows) - 1)
    a, da, dda = compute_spline_weights(s - i)
    b, db, ddb = compute_spline_weights(t - j)
    width = int(shape.columns) + 3
    first = j * width + i
    # Four calls, not a loop: in a loop, the compiler would read the weights from memory by index.
    z0, s0, ss0 = read_row(shape, first, a, da, dda)
    z1, s1, ss1 = read_row(shape, first + width, a, da, dda)
    z2, s2, ss2 = read_row(shape, first + 2 * width, a, da, dda)
    z3, s3, ss3 = read_row(shape, first + 3 * width, a, da, dda)
    return Height(
        z=weigh(b, z0, z1, z2, z3),
        s=weigh(b, s0, s1, s2, s3),
        t=weigh(db, z0, z1, z2, z3),
        ss=weigh(b, ss0, ss1, ss2, ss3),
        st=weigh(db, s0, s1, s2, s3),
        tt=weigh(ddb, z0, z1, z2, z3),
    )


@jit
def find_foot(shape: Heightmap, p: Vec3, s: float, t: float) -> MapFoot:
    here = compute_height(shape, s, t)
    ds, dt, w = s - p[0], t - p[1], here.z - p[2]
    return MapFoot(s, t, here, ds * ds + dt * dt + w * w)


@jit
def compute_gradient(p: Vec3, foot: MapFoot) -> tuple[float, float]:
    """Return g, half of the gradient of the squared distance."""
    w = foot.height.z - p[2]
    return foot.s - p[0] + w * foot.height.s, foot.t - p[1] + w * foot.height.t


@jit
def solve_by_newton(p: Vec3, foot: MapFoot) -> tuple[float, float]:
    """Return the Newton step; where D is not convex, with the absolute values of the eigenvalues of H."""
    h = foot.height
    w = h.z - p[2]
    gs, gt = compute_gradient(p, foot)
    ss, tt, st = 1.0 + h.s * h.s + w * h.ss, 1.0 + h.t * h.t + w * h.tt, h.s * h.t + w * h.st
    volume = ss * tt - st * st
    if ss > 0.0 and volume > MIN_SECOND_DERIVATIVE * ss * tt:
        return (st * gt - tt * gs) / volume, (st * gs - ss * gt) / volume
    mean, half = 0.5 * (ss + tt), 0.5 * (ss - tt)
    spread = sqrt(half * half + st * st)
    _, axis = compute_direction((half + spread, st, 0.0) if half >= 0.0 else (st, spread - half, 0.0), (1.0, 0.0, 0.0))
    first, second = max(abs(mean + spread), MIN_SECOND_DERIVATIVE), max(abs(mean - spread), MIN_SECOND_DERIVATIVE)
    along, across = (axis[0] * gs + axis[1] * gt) / first, (axis[0] * gt - axis[1] * gs) / second
    return axis[1] * across - axis[0] * along, -axis[1] * along - axis[0] * across


@jit
def descend(shape: Heightmap, p: Vec3, start: MapPoint, reach: float) -> tuple[MapFoot, int]:
    """Descend from `start` to a foot point of `p`; return it and the number of height evaluations.

    reach  distance along s or t from `start` at which the descent stops without a foot point
    """
    foot, looks = find_foot(shape, p, start.s, start.t), 1
    for _ in range(MAX_NEWTON_STEPS):
        if looks >= MAX_EVALUATIONS:
            break
        ds, dt = solve_by_newton(p, foot)
        size = abs(ds) + abs(dt)
        next_foot = find_foot(shape, p, foot.s + ds, foot.t + dt)
        looks += 1
        if size > UNCHECKED_STEP:
            for _ in range(MAX_REDUCTIONS):
                if next_foot.squared_distance < foot.squared_distance:
                    break
                ds, dt = 0.25 * ds, 0.25 * dt
                next_foot = find_foot(shape, p, foot.s + ds, foot.t + dt)
                looks += 1
            if not next_foot.squared_distance < foot.squared_distance:
                break
        foot = next_foot
        if size <= CONVERGED_STEP:
            break
        if abs(foot.s - start.s) > reach or abs(foot.t - start.t) > reach:
            break
    return foot, looks


@jit
def to_pitches(shape: Heightmap, x: Vec3) -> Vec3:
    per = 1.0 / shape.pitch
    return (x[0] * per + 0.5 * shape.columns, x[1] * per + 0.5 * shape.rows, x[2] * per)


@jit
def is_below(shape: Heightmap, x: Vec3) -> bool:
    """Return True if `x` (3,) m is in the solid."""
    p = to_pitches(shape, x)
    return compute_height(shape, p[0], p[1]).z > p[2]


@jit
def compute_gap_at_foot(shape: Heightmap, x: Vec3, foot: MapFoot) -> tuple[float, Vec3, Vec3]:
    """Return gap (m), point (3,) m and normal (3,) at a foot point of `x` (3,) m."""
    h = foot.height
    point = (
        (foot.s - 0.5 * shape.columns) * shape.pitch,
        (foot.t - 0.5 * shape.rows) * shape.pitch,
        h.z * shape.pitch,
    )
    normal = vec3.scale(1.0 / sqrt(1.0 + h.s * h.s + h.t * h.t), (-h.s, -h.t, 1.0))
    away = vec3.sub(x, point)
    gap = vec3.dot(away, normal)
    if (
        vec3.norm(vec3.add_scaled(away, -gap, normal)) > FOOT_SINE * abs(gap)
        and abs(gap) > CONVERGED_STEP * shape.pitch
    ):
        size, along = compute_direction(away, normal)
        sign = -1.0 if is_below(shape, x) else 1.0
        gap, normal = sign * size, vec3.scale(sign, along)
    return gap, point, normal


@curvature.of(Heightmap)
def curvature_of_heightmap(shape: Heightmap, radius: float, point: Vec3, normal: Vec3) -> tuple[float, float, Vec3]:
    """Return the curvature of the graph: -a . h'' a / |(-h', 1)| along a unit tangent with the part a in the grid."""
    p = to_pitches(shape, point)
    h = compute_height(shape, p[0], p[1])
    steep = 1.0 + h.s * h.s + h.t * h.t
    up = vec3.scale(1.0 / sqrt(steep), (-h.s, -h.t, 1.0))
    _, u = compute_direction((1.0, 0.0, h.s), Z_AXIS)
    v = vec3.cross(up, u)
    per = -1.0 / (shape.pitch * sqrt(steep))
    us, ut = h.ss * u[0] + h.st * u[1], h.st * u[0] + h.tt * u[1]
    vs, vt = h.ss * v[0] + h.st * v[1], h.st * v[0] + h.tt * v[1]
    uu, uv, vv = per * (u[0] * us + u[1] * ut), per * (v[0] * us + v[1] * ut), per * (v[0] * vs + v[1] * vt)
    half = 0.5 * (uu - vv)
    spread = sqrt(half * half + uv * uv)
    along = (half + spread, uv, 0.0) if half >= 0.0 else (uv, spread - half, 0.0)
    _, turned = compute_direction(along, (1.0, 0.0, 0.0))
    mean = 0.5 * (uu + vv)
    first = vec3.add_scaled(vec3.scale(turned[0], u), turned[1], v)
    return compute_offset_curvature(mean + spread, radius), compute_offset_curvature(mean - spread, radius), first


@concavity.of(Heightmap)
def concavity_of_heightmap(shape: Heightmap, radius: float, point: Vec3, normal: Vec3) -> float:
    k1, k2, _ = curvature(shape, radius, point, normal)
    return max(-min(k1, k2), 0.0)
