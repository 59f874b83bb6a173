"""What every shape can do, and the parts that most of them share.

    closest(shape, x)                        -> gap, point, normal  of the surface point nearest to x
    curvature(shape, radius, point, normal)  -> k1, k2, d1          of the surface the fingertip's centre moves on

These two are all that a new shape has to give. What follows has a default, which serves whatever `closest` and
`curvature` describe; a shape says otherwise where it knows better, as the plane does.

    closest_from(shape, x, start, budget)    -> as `closest`, budget for a fingertip that rolls there from a point
    closest_or_bound(shape, x)               -> as `closest`, 1 where a search did not end
    closest_within(shape, x, budget)         -> as `closest`, budget with what is left of the tick's
    constraint_at(shape, center, radius, n, budget) -> point, n, budget where it holds a fingertip as it did before
    transport(shape, v, n_from, n_to)        -> (3,)                tangent vector v carried to the new normal
    is_hollow(shape)                         -> bool                whether it is touched from inside; default: no
    bend(shape, radius, point, normal)       -> 1/m                 how much it bends round the fingertip
    follows(shape, radius, start, normal, end)                      whether a roll takes the centre there; default: yes
    travel(shape, start, end, radius, leaves)                       how far a fingertip gets until it meets the shape
    rest_on(shape, pose, radius, ...)                               where the proxy rests on it
    ahead(shape, radius, center, ...)                               where the centre gets by going straight ahead
    tangent_plane(shape, normal)                                    the plane through the origin that it is like there
    unroll(shape, radius, center, ...)                              rolling in closed form, without a default

What takes long has a `budget`, and returns what is left of it, below 0 where it was used up. Only what is asked of
meshes and height maps is counted. Those two have no `closest`: their nearest point comes with the word of whether the
search for it ended, or not at all.

Defaults stand beside what they are made of: rest_on in contact/rest/alone, ahead and unroll in contact/rolling. A shape
that can be touched from inside has `side`, +1 or -1, and calls `may_be_hollow`.

All in the frame of the shape, for any x within 1e100 m. `gap` is the signed distance, m, positive where the fingertip
may be, and `normal` the unit normal that points there. `curvature` is that of the offset surface, a distance `radius`
from the shape: with k of the shape itself it is k / (1 + radius k), finite on a sharp edge too. k1 and k2, 1/m, are
principal, positive where the surface bulges towards the fingertip; d1 is the unit tangent of k1, and normal x d1 that
of k2.
"""

from math import sqrt
from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.model import Plane, Vec3
from softfinger.proxy.kernels.numerics import vec3

X_AXIS: Vec3 = (1.0, 0.0, 0.0)
Y_AXIS: Vec3 = (0.0, 1.0, 0.0)
Z_AXIS: Vec3 = (0.0, 0.0, 1.0)

FAN = 1e-9
"""A component of a normal below this is none: rotating the normal out of the world and back leaves 1e-16."""
BUDGET_OF_A_ROLL = 600
"""What a roll may ask."""
NO_HIT = 2.0
"""Share of the way that says: nothing was met on it."""


@by_type
def closest(shape: Any, x: Vec3) -> Any: ...


@by_type
def closest_from(shape: Any, x: Vec3, start: Vec3, budget: int) -> Any:
    """`closest` for a fingertip that rolls there from the surface point `start` (3,) m: where many points are near
    what is downhill from there will do. And what is left of the budget."""


@closest_from.otherwise
def closest_from_anywhere(shape: Any, x: Vec3, start: Vec3, budget: int) -> tuple[float, Vec3, Vec3, int]:
    gap, point, normal = closest(shape, x)
    return gap, point, normal, budget


@by_type
def closest_within(shape: Any, x: Vec3, budget: int) -> Any:
    """`closest`, and what is left of the `budget`. Where it is used up the gap is a bound."""


@closest_within.otherwise
def closest_without_budget(shape: Any, x: Vec3, budget: int) -> tuple[float, Vec3, Vec3, int]:
    gap, point, normal = closest(shape, x)
    return gap, point, normal, budget


@by_type
def closest_or_bound(shape: Any, x: Vec3) -> Any:
    """`closest` for what is no contact, and 1 where a search as large as a shape allows did not end, else 0: then the
    point is the nearest known, and others may be nearer."""


@closest_or_bound.otherwise
def closest_without_search(shape: Any, x: Vec3) -> tuple[float, Vec3, Vec3, float]:
    gap, point, normal = closest(shape, x)
    return gap, point, normal, 0.0


@by_type
def constraint_at(shape: Any, center: Vec3, radius: float, normal: Vec3, budget: int) -> Any:
    """Point and normal where it holds a fingertip at `center` (3,) m, that it held with that normal before: near there,
    where a shape may hold it in several places. And what is left of the budget."""


@constraint_at.otherwise
def constraint_where_nearest(
    shape: Any, center: Vec3, radius: float, normal: Vec3, budget: int
) -> tuple[Vec3, Vec3, int]:
    _, point, normal = closest(shape, center)
    return point, normal, budget


@by_type
def curvature(shape: Any, radius: float, point: Vec3, normal: Vec3) -> Any: ...


@by_type
def transport(shape: Any, v: Vec3, normal_from: Vec3, normal_to: Vec3) -> Any: ...


@by_type
def is_hollow(shape: Any) -> Any:
    """Whether the fingertip is inside: then the surface bends round it."""


@by_type
def follows(shape: Any, radius: float, start: Vec3, normal: Vec3, end: Vec3) -> Any:
    """Whether the fingertip's centre may go from `start` (3,) m, with that normal, to `end`, where its roll leads."""


@by_type
def travel(shape: Any, start: Vec3, end: Vec3, radius: float, leaves: bool) -> Any:
    """Share of the way from start to end (local points) at which a sphere of that radius meets the shape.

    A way that ends inside has met it, at its start if that lies inside too; `leaves` lets one go on from there that
    gets no deeper, as that of a proxy which rests on the shape to rounding. NO_HIT where nothing is met.
    """


@by_type
def rest_on(shape: Any, pose: Any, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, normal: Vec3) -> Any:
    """Proxy and normal on a single object of this shape and pose, all but the shape in the world; and 1 if the
    proxy stays where it was since the budget of the search was used up."""


@by_type
def ahead(shape: Any, radius: float, center: Vec3, normal: Vec3, along: Vec3, length: float) -> Any:
    """Centre (3,) m after `length` m along the unit tangent `along` of the offset surface."""


@by_type
def unroll(shape: Any, radius: float, center: Vec3, normal: Vec3, w: Vec3) -> Any:
    """Rolling by the rotation vector `w` (3,) rad at a constant rate; returns Roll."""


@by_type
def tangent_plane(shape: Any, normal: Vec3) -> Any:
    """A shape, flat, on which the fingertip rolls as it begins to on this one where it has that normal."""


@tangent_plane.otherwise
def plane_with_normal(shape: Any, normal: Vec3) -> Plane:
    return Plane(normal, 0.0)


@by_type
def bend(shape: Any, radius: float, point: Vec3, normal: Vec3) -> Any:
    """How much the surface that the fingertip's centre moves on bends round it, 1/m; 0 for what is not hollow."""


@follows.otherwise
def follows_anywhere(shape: Any, radius: float, start: Vec3, normal: Vec3, end: Vec3) -> bool:
    return True


@is_hollow.otherwise
def never_hollow(shape: Any) -> bool:
    return False


@bend.otherwise
def no_bend(shape: Any, radius: float, point: Vec3, normal: Vec3) -> float:
    return 0.0


def bend_from_inside(shape: Any, radius: float, point: Vec3, normal: Vec3) -> float:
    if shape.side > 0.0:
        return 0.0
    k1, k2, _ = curvature(shape, radius, point, normal)
    return max(-min(k1, k2), 0.0)


def hollow_from_inside(shape: Any) -> bool:
    return shape.side < 0.0


def may_be_hollow(kind: type) -> None:
    """Shapes of this kind have `side`, -1 for those that are touched from inside."""
    is_hollow.of(kind)(hollow_from_inside)
    bend.of(kind)(bend_from_inside)


@jit
def direction(v: Vec3, otherwise: Vec3) -> tuple[float, Vec3]:
    """Length of `v` and the unit vector along it; `otherwise` where `v` is zero. Any finite `v` will do."""
    square = vec3.dot(v, v)
    if 1e-250 < square < 1e250:
        length = sqrt(square)
        return length, vec3.scale(1.0 / length, v)
    largest = max(abs(v[0]), abs(v[1]), abs(v[2]))
    if largest == 0.0:
        return 0.0, otherwise
    shape = (v[0] / largest, v[1] / largest, v[2] / largest)
    length = vec3.norm(shape)
    return largest * length, vec3.scale(1.0 / length, shape)


@jit
def around_z(normal: Vec3) -> Vec3:
    """Unit tangent that goes round the z axis, counter-clockwise; x where the normal is along the axis."""
    length = sqrt(normal[0] * normal[0] + normal[1] * normal[1])
    if length <= FAN:
        return X_AXIS
    return (-normal[1] / length, normal[0] / length, 0.0)


@jit
def any_tangent(normal: Vec3) -> Vec3:
    """Some unit vector at right angles to the unit vector `normal`, without a difference of close numbers."""
    if abs(normal[1]) <= 0.8:
        length = sqrt(normal[0] * normal[0] + normal[2] * normal[2])
        return (normal[2] / length, 0.0, -normal[0] / length)
    length = sqrt(normal[0] * normal[0] + normal[1] * normal[1])
    return (normal[1] / length, -normal[0] / length, 0.0)


@jit
def offset(k: float, radius: float) -> float:
    """Curvature at a distance `radius` from a surface of curvature `k`, 1/m.

    A fingertip that fits has 1 + radius k > 0; what does not fit gets a large curvature, not an infinite one.
    """
    return k / max(1.0 + radius * k, 1e-9)


@jit
def turn_along(v: Vec3, normal_from: Vec3, normal_to: Vec3) -> Vec3:
    """`v` turned by the smallest rotation that takes one unit normal to the other.

    As two reflections, the first at the plane half way: the length of a tangent `v` is kept to rounding however far
    the normal turns. Opposite normals have no smallest rotation; half a turn about a fixed tangent serves.
    """
    middle = vec3.add(normal_from, normal_to)
    square = vec3.dot(middle, middle)
    if square < 1e-28:
        middle, square = any_tangent(normal_from), 1.0
    # One division for all vectors that are carried between the same two normals.
    flipped = vec3.add_scaled(v, (-2.0 / square) * vec3.dot(middle, v), middle)
    return vec3.add_scaled(flipped, 2.0 * vec3.dot(normal_from, v), normal_to)


@transport.otherwise
def transport_by_turning(shape: Any, v: Vec3, normal_from: Vec3, normal_to: Vec3) -> Vec3:
    return turn_along(v, normal_from, normal_to)


ADVANCES = 32
"""Steps of a sweep; each goes as far as the clearance allows, so most sweeps take one or two."""


NARROWINGS = 24
"""Thirds that are left out in the search for where a glancing way is nearest: 6e-5 of it remain."""
TOUCHING = 1e-9
"""Clearance, as a share of the radius, that counts as none."""


@travel.otherwise
def travel_to_shape(shape: Any, start: Vec3, end: Vec3, radius: float, leaves: bool) -> float:
    """Conservative advancement: go as far as the clearance, which nothing can be nearer than; ask again."""
    way = vec3.sub(end, start)
    length = vec3.norm(way)
    gap, _, _ = closest(shape, start)
    clearance = gap - radius
    if clearance >= length:
        return NO_HIT
    touching = TOUCHING * radius
    if clearance <= touching:
        gap, _, _ = closest(shape, end)
        return 0.0 if gap - radius < (min(clearance, 0.0) if leaves else 0.0) else NO_HIT
    share = 0.0
    for _ in range(ADVANCES):
        share += clearance / length
        if share >= 1.0:
            return NO_HIT
        gap, _, _ = closest(shape, vec3.add_scaled(start, share, way))
        clearance = gap - radius
        if clearance <= touching:
            return share
    # A glancing way comes ever closer, and may pass: it meets if it is inside somewhere on what is left of it.
    gap, _, _ = closest(shape, end)
    low, high = share, 1.0
    for _ in range(NARROWINGS):
        if gap < radius:
            return share
        third = (high - low) / 3.0
        gap, _, _ = closest(shape, vec3.add_scaled(start, low + third, way))
        other, _, _ = closest(shape, vec3.add_scaled(start, high - third, way))
        if gap < other:
            high -= third
        else:
            low += third
            gap = other
    return NO_HIT


@by_type
def meets(shape: Any, start: Vec3, end: Vec3, radius: float, leaves: bool, budget: int) -> Any:
    """`travel`, the number of what is met on the shape, and what is left of the budget."""


@meets.otherwise
def meets_shape(
    shape: Any, start: Vec3, end: Vec3, radius: float, leaves: bool, budget: int
) -> tuple[float, float, int]:
    return travel(shape, start, end, radius, leaves), 0.0, budget
