"""Where the proxy rests on a surface that may touch the fingertip in several places at once: a height map.

Hills may stand closer than the fingertip is wide, and valleys bend more than it. So the surface that its centre moves
on has creases, in which it lies on two feet or three, and no single nearest point says where it may go. It is found
by cutting planes: of each foot the tangent plane, moved out by r; the point nearest to where probe and friction want
the centre that is behind none of them; there the feet anew, and whether some other place of the map is nearer than r,
which is a foot then, too. On one foot alone the curvature of the offset surface makes that Newton's
method. What the tick ends with has been asked of the whole map: the proxy is never inside of it. And no step is longer
than the fingertip's clearance, so it goes round no ridge.
"""

from typing import Any, Final, NamedTuple

from softfinger.proxy.kernels.contact.half_spaces import displacement, hold
from softfinger.proxy.kernels.geometry import vec3
from softfinger.proxy.kernels.geometry.surfaces import curvature, follows
from softfinger.proxy.kernels.geometry.surfaces.contract import direction
from softfinger.proxy.kernels.geometry.surfaces.heightmap import near
from softfinger.proxy.kernels.geometry.surfaces.tiles import nearest_from
from softfinger.proxy.kernels.model import Heightmap, Vec3
from softfinger.proxy.kernels.native.jit import jit
from softfinger.proxy.kernels.native.outlined import outlined

INSIDE: Final = 1e-10
"""Depth, as a share of the fingertip's radius, that is rounding; the same as in `constraints`, as is the next."""
SETTLED: Final = 1e-13
"""Step, as a share of the fingertip's radius, below which the proxy is at rest."""
ROUNDS: Final = 8
"""Of cutting planes in a tick; on one foot two or three are taken, in a crease some five."""
SLIDING_ROUND: Final = 1
"""The round with which a proxy that slides may end: what is left the next tick takes up."""
STRIDE: Final = 0.9
"""Share of the radius that the centre goes in one step: nothing is nearer than the radius, so nothing is crossed."""
SAME: Final = 1e-6
"""Share of the radius within which two feet are one."""
ON: Final = 1e-9
"""Share of the radius, and sine, by which the fingertip's lowest point may miss the surface and still be its foot."""
SHORTEST: Final = 0.25
"""1 - depth x curvature at the least: Newton's step is four times that in the tangent plane at the most."""


class Feet(NamedTuple):
    """Surface points (3,) m that hold the fingertip, `many` of them."""

    many: int
    one: Vec3
    two: Vec3
    three: Vec3


@jit
def is_foot(feet: Feet, point: Vec3, within: float) -> bool:
    """Whether that is one of them, within a distance, m."""
    if vec3.norm(vec3.sub(point, feet.one)) <= within:
        return True
    if feet.many > 1 and vec3.norm(vec3.sub(point, feet.two)) <= within:
        return True
    return feet.many > 2 and vec3.norm(vec3.sub(point, feet.three)) <= within


@jit
def with_foot(feet: Feet, point: Vec3) -> Feet:
    """With one more; in place of the last, where there are three."""
    if feet.many == 1:
        return Feet(2, feet.one, point, point)
    return Feet(3, feet.one, feet.two, point)


@jit
def along_one(shape: Any, radius: float, goal: Vec3, foot: Vec3, normal: Vec3) -> Vec3:
    """From one foot the centre (3,) m nearest to `goal`, by Newton's step on the offset surface."""
    center = vec3.add_scaled(foot, radius, normal)
    way = vec3.sub(goal, center)
    depth = max(-vec3.dot(way, normal), 0.0)
    k1, k2, d1 = curvature(shape, radius, foot, normal)
    d2 = vec3.cross(normal, d1)
    first = vec3.dot(way, d1) / max(1.0 - depth * k1, SHORTEST)
    second = vec3.dot(way, d2) / max(1.0 - depth * k2, SHORTEST)
    return vec3.add_scaled(vec3.add_scaled(center, first, d1), second, d2)


@jit
def at_most(way: Vec3, longest: float) -> Vec3:
    length = vec3.norm(way)
    return vec3.scale(longest / length, way) if length > longest else way


@outlined
def lodge(shape: Any, radius: float, probe: Vec3, center: Vec3, lag: Vec3, normal: Vec3) -> tuple[Vec3, Vec3]:
    """Proxy and normal, in the frame of the shape: near `center` the centre nearest to the probe and `lag` (3,) m."""
    rest, up, slides = center, normal, lag != (0.0, 0.0, 0.0)
    feet = Feet(1, vec3.add_scaled(center, -radius, normal), center, center)
    for turn in range(ROUNDS):
        _, p1, n1 = near(shape, center, feet.one)
        p2, n2, p3, n3 = p1, n1, p1, n1
        if feet.many > 1:
            _, p2, n2 = near(shape, center, feet.two)
            p3, n3 = p2, n2
        if feet.many > 2:
            _, p3, n3 = near(shape, center, feet.three)
        feet = Feet(feet.many, p1, p2, p3)
        clear = True
        if turn > 0:
            gap, other, other_normal = nearest_from(shape, center, p1)
            clear = gap >= radius * (1.0 - INSIDE)
            if not clear and not is_foot(feet, other, SAME * radius):
                feet = with_foot(feet, other)
                p3, n3 = other, other_normal
                if feet.many == 2:
                    p2, n2 = other, other_normal
        goal = vec3.add(probe, vec3.reject(lag, up))
        if feet.many == 1:
            push, then = n1, along_one(shape, radius, goal, p1, n1)
        else:
            b1 = vec3.dot(n1, vec3.sub(p1, goal)) + radius
            b2 = vec3.dot(n2, vec3.sub(p2, goal)) + radius
            b3 = vec3.dot(n3, vec3.sub(p3, goal)) + radius
            held = hold(feet.many, n1, n2, n3, b1, b2, b3)
            push = displacement(held.push, n1, n2, n3)
            then = vec3.add(goal, displacement(held.place, n1, n2, n3))
        if turn > 0 and clear:
            rest = center
            _, up = direction(push, n1)
        then = vec3.add(rest, at_most(vec3.sub(then, rest), STRIDE * radius))
        if feet.many == 1:
            _, p1, n1 = near(shape, then, p1)
            landed = vec3.add_scaled(p1, radius, n1)
            if vec3.norm(vec3.sub(landed, rest)) <= radius:
                then = landed
        step = vec3.norm(vec3.sub(then, center))
        if turn > 0 and clear and (step <= SETTLED * radius or (slides and turn >= SLIDING_ROUND)):
            break
        center = then
    return rest, up


@follows.of(Heightmap)
def follows_over_heightmap(shape: Heightmap, radius: float, start: Vec3, normal: Vec3, end: Vec3) -> bool:
    """On one foot, not too far for a tick, and to a place where the fingertip has room."""
    foot = vec3.add_scaled(start, -radius, normal)
    _, point, up = near(shape, start, foot)
    if vec3.norm(vec3.sub(point, foot)) > ON * radius or vec3.dot(up, normal) < 1.0 - ON:
        return False
    way = vec3.norm(vec3.sub(end, start))
    if way > STRIDE * radius:
        return False
    gap, _, _ = nearest_from(shape, end, point)
    return gap >= radius * (1.0 - INSIDE)
