"""The height map: z = h(x, y), the solid below, h a bicubic spline through the heights of a grid.

A uniform cubic B-spline whose coefficients are chosen such that it goes through the heights: it is the only piecewise
cubic that is continuous with its first and second derivatives. So the normal turns without a step and curvature has
no jump, which is all that rolling asks of a surface; a bilinear or a Catmull-Rom surface would jerk at each pixel.
Beyond its rim the map levels off within three pixels and goes on flat, with the same derivatives.

Inside here lengths are in pitches, and (s, t) counts the cells of the grid from its corner. A foot of the point p is
where the distance is least nearby, found by Newton's method on D(s, t) = |(s, t, h) - p|^2 / 2,

    g = (s - p_s + w h_s, t - p_t + w h_t),  H = 1 + h' h'^T + w h'',  w = h - p_z

which is exact to rounding where it ends. As the surface is a graph, H is positive definite everywhere as long as w is
below the least radius with which any valley bends (or, from below, any ridge): then the only foot is the nearest point.
Elsewhere `nearest` finds out whether another foot is nearer.
"""

from math import sqrt
from typing import NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Heightmap, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.shapes.protocol import (
    Z_AXIS,
    bend,
    curvature,
    direction,
    offset,
)

STEPS = 24
"""Of Newton's method; it takes three to five, and more only where it starts far from any foot."""
HALVINGS = 8
"""Times that a step is shortened to a quarter for want of descent; past them rounding is all that is left."""
LOOKS = 48
"""Heights that are looked at on the way to a foot; some ten mostly."""
CONVERGED = 1e-7
"""Step, in pitches, after which the next would be below rounding: the convergence is quadratic."""
SURE = 1e-3
"""Step, in pitches, that is taken without a look at the distance, whose rounding would hide what it gains."""
LEAST = 1e-3
"""Of what the distance bends by in any direction, of 1 on a flat map: less is taken for it."""
SQUARE = 1e-6
"""Sine of the angle between the way to the foot and its normal above which it is no foot: the steps were not enough."""


Four = tuple[float, float, float, float]


class Height(NamedTuple):
    """h at a place and its derivatives, in pitches."""

    z: float
    s: float
    t: float
    ss: float
    st: float
    tt: float


class Place(NamedTuple):
    s: float
    t: float


class Foot(NamedTuple):
    """A place (s, t) where the distance is least nearby, what the surface is like there, and the distance's square."""

    s: float
    t: float
    height: Height
    square: float


@jit
def basis(f: float) -> tuple[Four, Four, Four]:
    """Uniform cubic B-spline: what four neighbours count for at 0 <= f <= 1 between the middle two, d/df, d2/df2."""
    b = 1.0 - f
    ff, bb = f * f, b * b
    value = (bb * b / 6.0, (4.0 - 3.0 * ff * (2.0 - f)) / 6.0, (4.0 - 3.0 * bb * (2.0 - b)) / 6.0, ff * f / 6.0)
    slope = (-0.5 * bb, (1.5 * f - 2.0) * f, (2.0 - 1.5 * b) * b, 0.5 * ff)
    return value, slope, (b, 3.0 * f - 2.0, 1.0 - 3.0 * f, f)


@jit
def held(place: float, count: float) -> float:
    """The coordinate within its `count` cells; 0 for what is no number."""
    if not place > 0.0:
        return 0.0
    return min(place, count)


@jit
def row_at(shape: Heightmap, at: int, a: Four, da: Four, dda: Four) -> Vec3:
    """Four neighbours of one row, from the number `at` on, weighted, with the row's first and second derivative."""
    c0, c1, c2, c3 = (
        shape.coefficients[at],
        shape.coefficients[at + 1],
        shape.coefficients[at + 2],
        shape.coefficients[at + 3],
    )
    return (
        a[0] * c0 + a[1] * c1 + a[2] * c2 + a[3] * c3,
        da[0] * c0 + da[1] * c1 + da[2] * c2 + da[3] * c3,
        dda[0] * c0 + dda[1] * c1 + dda[2] * c2 + dda[3] * c3,
    )


@jit
def weighted(weight: Four, z0: float, z1: float, z2: float, z3: float) -> float:
    return weight[0] * z0 + weight[1] * z1 + weight[2] * z2 + weight[3] * z3


@jit
def height_at(shape: Heightmap, s: float, t: float) -> Height:
    """Anywhere: the outermost cells are level outward, and what is farther out is as their border."""
    s, t = held(s, shape.columns), held(t, shape.rows)
    i, j = min(int(s), int(shape.columns) - 1), min(int(t), int(shape.rows) - 1)
    a, da, dda = basis(s - i)
    b, db, ddb = basis(t - j)
    width = int(shape.columns) + 3
    at = j * width + i
    # Four calls and no loop, in which the compiler would look up the weights by their number.
    z0, s0, ss0 = row_at(shape, at, a, da, dda)
    z1, s1, ss1 = row_at(shape, at + width, a, da, dda)
    z2, s2, ss2 = row_at(shape, at + 2 * width, a, da, dda)
    z3, s3, ss3 = row_at(shape, at + 3 * width, a, da, dda)
    return Height(
        z=weighted(b, z0, z1, z2, z3),
        s=weighted(b, s0, s1, s2, s3),
        t=weighted(db, z0, z1, z2, z3),
        ss=weighted(b, ss0, ss1, ss2, ss3),
        st=weighted(db, s0, s1, s2, s3),
        tt=weighted(ddb, z0, z1, z2, z3),
    )


@jit
def foot_at(shape: Heightmap, p: Vec3, s: float, t: float) -> Foot:
    here = height_at(shape, s, t)
    ds, dt, w = s - p[0], t - p[1], here.z - p[2]
    return Foot(s, t, here, ds * ds + dt * dt + w * w)


@jit
def gradient(p: Vec3, foot: Foot) -> tuple[float, float]:
    """g: how the distance's square changes along s and t, half of it."""
    w = foot.height.z - p[2]
    return foot.s - p[0] + w * foot.height.s, foot.t - p[1] + w * foot.height.t


@jit
def newton(p: Vec3, foot: Foot) -> tuple[float, float]:
    """The step; where the distance is not convex that of a function bent as much upward along the same two axes."""
    h = foot.height
    w = h.z - p[2]
    gs, gt = gradient(p, foot)
    ss, tt, st = 1.0 + h.s * h.s + w * h.ss, 1.0 + h.t * h.t + w * h.tt, h.s * h.t + w * h.st
    volume = ss * tt - st * st
    if ss > 0.0 and volume > LEAST * ss * tt:
        return (st * gt - tt * gs) / volume, (st * gs - ss * gt) / volume
    mean, half = 0.5 * (ss + tt), 0.5 * (ss - tt)
    spread = sqrt(half * half + st * st)
    _, axis = direction((half + spread, st, 0.0) if half >= 0.0 else (st, spread - half, 0.0), (1.0, 0.0, 0.0))
    first, second = max(abs(mean + spread), LEAST), max(abs(mean - spread), LEAST)
    along, across = (axis[0] * gs + axis[1] * gt) / first, (axis[0] * gt - axis[1] * gs) / second
    return axis[1] * across - axis[0] * along, -axis[1] * along - axis[0] * across


@jit
def descend(shape: Heightmap, p: Vec3, start: Place, reach: float) -> tuple[Foot, int]:
    """The foot of `p` that is downhill from `start`, or where the way to it goes farther than `reach`; and how many
    heights were looked at."""
    foot, looks = foot_at(shape, p, start.s, start.t), 1
    for _ in range(STEPS):
        if looks >= LOOKS:
            break
        ds, dt = newton(p, foot)
        size = abs(ds) + abs(dt)
        then = foot_at(shape, p, foot.s + ds, foot.t + dt)
        looks += 1
        if size > SURE:
            for _ in range(HALVINGS):
                if then.square < foot.square:
                    break
                ds, dt = 0.25 * ds, 0.25 * dt
                then = foot_at(shape, p, foot.s + ds, foot.t + dt)
                looks += 1
            if not then.square < foot.square:
                break
        foot = then
        if size <= CONVERGED:
            break
        if abs(foot.s - start.s) > reach or abs(foot.t - start.t) > reach:
            break
    return foot, looks


@jit
def in_pitches(shape: Heightmap, x: Vec3) -> Vec3:
    per = 1.0 / shape.pitch
    return (x[0] * per + 0.5 * shape.columns, x[1] * per + 0.5 * shape.rows, x[2] * per)


@jit
def is_below(shape: Heightmap, x: Vec3) -> bool:
    """Whether `x` (3,) m is in the solid."""
    p = in_pitches(shape, x)
    return height_at(shape, p[0], p[1]).z > p[2]


@jit
def touching(shape: Heightmap, x: Vec3, foot: Foot) -> tuple[float, Vec3, Vec3]:
    """Gap, point and normal of a foot of `x`."""
    h = foot.height
    point = (
        (foot.s - 0.5 * shape.columns) * shape.pitch,
        (foot.t - 0.5 * shape.rows) * shape.pitch,
        h.z * shape.pitch,
    )
    normal = vec3.scale(1.0 / sqrt(1.0 + h.s * h.s + h.t * h.t), (-h.s, -h.t, 1.0))
    away = vec3.sub(x, point)
    gap = vec3.dot(away, normal)
    if vec3.norm(vec3.add_scaled(away, -gap, normal)) > SQUARE * abs(gap) and abs(gap) > CONVERGED * shape.pitch:
        size, along = direction(away, normal)
        sign = -1.0 if is_below(shape, x) else 1.0
        gap, normal = sign * size, vec3.scale(sign, along)
    return gap, point, normal


@curvature.of(Heightmap)
def curvature_of_heightmap(shape: Heightmap, radius: float, point: Vec3, normal: Vec3) -> tuple[float, float, Vec3]:
    """Of the graph: a tangent a bends by -a . h'' a / |(-h', 1)|, a the part of it in the plane of the grid."""
    at = in_pitches(shape, point)
    h = height_at(shape, at[0], at[1])
    steep = 1.0 + h.s * h.s + h.t * h.t
    up = vec3.scale(1.0 / sqrt(steep), (-h.s, -h.t, 1.0))
    _, u = direction((1.0, 0.0, h.s), Z_AXIS)
    v = vec3.cross(up, u)
    per = -1.0 / (shape.pitch * sqrt(steep))
    us, ut = h.ss * u[0] + h.st * u[1], h.st * u[0] + h.tt * u[1]
    vs, vt = h.ss * v[0] + h.st * v[1], h.st * v[0] + h.tt * v[1]
    uu, uv, vv = per * (u[0] * us + u[1] * ut), per * (v[0] * us + v[1] * ut), per * (v[0] * vs + v[1] * vt)
    half = 0.5 * (uu - vv)
    spread = sqrt(half * half + uv * uv)
    along = (half + spread, uv, 0.0) if half >= 0.0 else (uv, spread - half, 0.0)
    _, turned = direction(along, (1.0, 0.0, 0.0))
    mean = 0.5 * (uu + vv)
    first = vec3.add_scaled(vec3.scale(turned[0], u), turned[1], v)
    return offset(mean + spread, radius), offset(mean - spread, radius), first


@bend.of(Heightmap)
def bend_of_heightmap(shape: Heightmap, radius: float, point: Vec3, normal: Vec3) -> float:
    k1, k2, _ = curvature(shape, radius, point, normal)
    return max(-min(k1, k2), 0.0)
