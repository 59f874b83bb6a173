"""Functions that a shape implements, and helpers shared by most shapes.

    closest(shape, x)                        -> gap, point, normal  of the surface point nearest to x
    curvature(shape, radius, point, normal)  -> k1, k2, d1          of the surface the fingertip's centre moves on

A new shape only has to implement these two. The following functions have defaults that use them; a shape overrides a
default if it has a better method, as the plane does.

    closest_from(shape, x, start, budget)    -> as `closest`, budget; for a fingertip that rolls from the point `start`
    closest_or_bound(shape, x)               -> as `closest`, 1 if the search did not finish
    closest_within(shape, x, budget)         -> as `closest`, budget; within the budget of the tick
    constraint_at(shape, center, radius, n, budget) -> point, n, budget of an active constraint with the last normal n
    transport(shape, v, n_from, n_to)        -> (3,)                tangent vector v transported to the new normal
    is_hollow(shape)                         -> bool                True if touched from inside; default: False
    concavity(shape, radius, point, normal)  -> 1/m                 curvature of the offset surface round the fingertip
    follows(shape, radius, start, normal, end) -> bool              True if the centre may roll there; default: True
    travel(shape, start, end, radius, in_contact) -> 0 to 1         share of the path until the fingertip hits the shape
    rest_on(shape, pose, radius, ...)                               rest position of the proxy
    ahead(shape, radius, center, ...)                               centre after a straight motion on the surface
    unroll(shape, radius, center, ...)                              rolling in closed form; no default

Expensive functions take a `budget` and return the remaining one, below 0 if it was exhausted. Only queries of meshes
and height maps are counted. These two do not implement `closest`: their queries also return if the search finished.

Some defaults are elsewhere, next to the code that they use: rest_on in contact/rest/one_object, ahead and unroll in
contact/rolling. A shape that can be touched from inside has `side`, +1 or -1, and calls `may_be_hollow`.

Everything is in the frame of the shape, for any x within 1e100 m. `gap` is the signed distance, m, positive on the side
of the fingertip, and `normal` the unit normal towards that side. `curvature` is that of the offset surface at the
distance `radius` from the shape: k / (1 + radius k) with k of the shape, finite on a sharp edge, too. k1 and k2, 1/m,
are the principal curvatures, positive if the surface is convex towards the fingertip; d1 is the unit tangent of k1, and
normal x d1 that of k2.
"""

from math import sqrt
from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type, by_type_with_default
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.shapes.budget import INSIDE_TOLERANCE, MAX_STRIDE

X_AXIS: Vec3 = (1.0, 0.0, 0.0)
Y_AXIS: Vec3 = (0.0, 1.0, 0.0)
Z_AXIS: Vec3 = (0.0, 0.0, 1.0)

MIN_NORMAL_COMPONENT = 1e-9
"""A component of a normal below this counts as zero: rotating a normal to the world frame and back leaves 1e-16."""
BUDGET_OF_A_ROLL = 600
"""Budget of a rolling step with step control, or of each query in the other rolling methods."""
NO_HIT = 2.0
"""Share of the path returned by `travel` if nothing was hit."""


@by_type
def closest(shape: Any, x: Vec3) -> Any: ...


@by_type_with_default
def closest_from(shape: Any, x: Vec3, start: Vec3, budget: int) -> tuple[float, Vec3, Vec3, int]:
    """Return `closest` for a fingertip that rolls there from the surface point `start` (3,) m, and the budget left.

    A local nearest point, reached by descent from `start`, is enough.
    """
    gap, point, normal = closest(shape, x)
    return gap, point, normal, budget


@by_type_with_default
def closest_within(shape: Any, x: Vec3, budget: int) -> tuple[float, Vec3, Vec3, int]:
    """Return `closest` and the remaining budget; if it is exhausted, the gap is a lower bound."""
    gap, point, normal = closest(shape, x)
    return gap, point, normal, budget


@by_type_with_default
def closest_or_bound(shape: Any, x: Vec3) -> tuple[float, Vec3, Vec3, float]:
    """Return `closest` for uses other than contact, and 1 if the largest possible search did not finish, otherwise 0.

    If it did not finish, the point is the nearest known, but a closer one may exist.
    """
    gap, point, normal = closest(shape, x)
    return gap, point, normal, 0.0


@by_type_with_default
def constraint_at(shape: Any, center: Vec3, radius: float, normal: Vec3, budget: int) -> tuple[Vec3, Vec3, int]:
    """Return contact point and normal of a fingertip at `center` (3,) m, and the remaining budget.

    normal  (3,)  previous normal of this constraint; selects one of several contact points of a shape
    """
    _, point, normal = closest(shape, center)
    return point, normal, budget


@by_type
def curvature(shape: Any, radius: float, point: Vec3, normal: Vec3) -> Any: ...


@by_type_with_default
def transport(shape: Any, v: Vec3, normal_from: Vec3, normal_to: Vec3) -> Vec3:
    return turn_along(v, normal_from, normal_to)


@by_type_with_default
def is_hollow(shape: Any) -> bool:
    """Return True if the fingertip is inside the shape, so that the surface bends round it."""
    return False


@by_type_with_default
def follows(shape: Any, radius: float, start: Vec3, normal: Vec3, end: Vec3) -> bool:
    """Return True if the fingertip's centre may roll from `start` (3,) m, with that normal, to `end` (3,) m."""
    return True


@by_type
def travel(shape: Any, start: Vec3, end: Vec3, radius: float, in_contact: bool) -> Any:
    """Return the share of the path from `start` to `end` at which a sphere of that radius hits the shape, or NO_HIT.

    A path that ends inside is a hit, at its start if the start is inside, too.

    in_contact  True for a proxy on the shape, which may be inside by rounding. A path that starts inside and gets no
                deeper then is not a hit, nor is a short path that ends outside: the fingertip at its two ends covers
                it, and a proxy that follows a curved surface moves on a chord.
    """


@by_type
def rest_on(shape: Any, pose: Any, radius: float, probe: Vec3, center: Vec3, deflection: Vec3, normal: Vec3) -> Any:
    """Return the rest position of the proxy on a single object, the normal there, and a flag.

    pose  pose of the object; everything except `shape` is in the world frame

    The flag is 1 if the search exhausted its budget before the rest position was found, otherwise 0.
    """


@by_type
def ahead(shape: Any, radius: float, center: Vec3, normal: Vec3, motion: Vec3) -> Any:
    """Return the centre (3,) m after moving straight ahead on the offset surface by the tangent vector `motion` m."""


@by_type
def unroll(shape: Any, radius: float, center: Vec3, normal: Vec3, w: Vec3) -> Any:
    """Roll by the rotation vector `w` (3,) rad at a constant rate; return a Roll."""


@by_type_with_default
def concavity(shape: Any, radius: float, point: Vec3, normal: Vec3) -> float:
    """Return the largest curvature with which the offset surface bends round the fingertip, 1/m; 0 if it does not."""
    return 0.0


def concavity_from_side(shape: Any, radius: float, point: Vec3, normal: Vec3) -> float:
    if shape.side > 0.0:
        return 0.0
    k1, k2, _ = curvature(shape, radius, point, normal)
    return max(-min(k1, k2), 0.0)


def hollow_from_inside(shape: Any) -> bool:
    return shape.side < 0.0


def may_be_hollow(kind: type) -> None:
    """Register shapes that have `side`, -1 if touched from inside."""
    is_hollow.of(kind)(hollow_from_inside)
    concavity.of(kind)(concavity_from_side)


@jit
def compute_direction(v: Vec3, otherwise: Vec3) -> tuple[float, Vec3]:
    """Return the length of `v` and the unit vector along it, or `otherwise` if `v` is zero; for any finite `v`."""
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
    """Return the unit tangent round the z axis, counter-clockwise; the x axis if the normal is along z."""
    length = sqrt(normal[0] * normal[0] + normal[1] * normal[1])
    if length <= MIN_NORMAL_COMPONENT:
        return X_AXIS
    return (-normal[1] / length, normal[0] / length, 0.0)


@jit
def any_tangent(normal: Vec3) -> Vec3:
    """Return a unit vector perpendicular to the unit vector `normal`, without a difference of close numbers."""
    if abs(normal[1]) <= 0.8:
        length = sqrt(normal[0] * normal[0] + normal[2] * normal[2])
        return (normal[2] / length, 0.0, -normal[0] / length)
    length = sqrt(normal[0] * normal[0] + normal[1] * normal[1])
    return (normal[1] / length, -normal[0] / length, 0.0)


@jit
def compute_offset_curvature(k: float, radius: float) -> float:
    """Return the curvature at the distance `radius` from a surface of curvature `k`, 1/m.

    A fingertip that fits has 1 + radius k > 0; for one that does not, the curvature is large, but finite.
    """
    return k / max(1.0 + radius * k, 1e-9)


@jit
def turn_along(v: Vec3, normal_from: Vec3, normal_to: Vec3) -> Vec3:
    """Rotate `v` by the smallest rotation from one unit normal to the other.

    Two reflections, the first at the plane normal to the mean of the two normals: they preserve the length of a tangent
    `v` to rounding for any angle. Opposite normals have no smallest rotation: this uses half a turn about a fixed axis.
    """
    middle = vec3.add(normal_from, normal_to)
    square = vec3.dot(middle, middle)
    if square < 1e-28:
        middle, square = any_tangent(normal_from), 1.0
    # A single division, which is shared by all vectors transported between the same two normals.
    flipped = vec3.add_scaled(v, (-2.0 / square) * vec3.dot(middle, v), middle)
    return vec3.add_scaled(flipped, 2.0 * vec3.dot(normal_from, v), normal_to)


MAX_ADVANCES = 32
"""Limit of the steps of a sweep; each is as long as the clearance, so most sweeps take one or two."""


MAX_NARROWINGS = 24
"""Steps of the ternary search for the closest point of a grazing path: 6e-5 of the interval remain."""
TOUCHING_CLEARANCE = 1e-9
"""Clearance, as a share of the radius, below which it counts as zero."""


@travel.otherwise
def travel_to_shape(shape: Any, start: Vec3, end: Vec3, radius: float, in_contact: bool) -> float:
    """Conservative advancement: repeatedly move by the clearance, within which there is no obstacle."""
    path = vec3.sub(end, start)
    length = vec3.norm(path)
    gap, _, _ = closest(shape, start)
    clearance = gap - radius
    if clearance >= length:
        return NO_HIT
    if in_contact and length <= MAX_STRIDE * radius:
        gap, _, _ = closest(shape, end)
        if gap >= radius * (1.0 - INSIDE_TOLERANCE):
            return NO_HIT
    touching = TOUCHING_CLEARANCE * radius
    if clearance <= touching:
        gap, _, _ = closest(shape, end)
        return 0.0 if gap - radius < (min(clearance, 0.0) if in_contact else 0.0) else NO_HIT
    share = 0.0
    for _ in range(MAX_ADVANCES):
        share += clearance / length
        if share >= 1.0:
            return NO_HIT
        gap, _, _ = closest(shape, vec3.add_scaled(start, share, path))
        clearance = gap - radius
        if clearance <= touching:
            return share
    # A grazing path may pass the shape without touching it: it is a hit only if its remainder is inside somewhere.
    gap, _, _ = closest(shape, end)
    low, high = share, 1.0
    for _ in range(MAX_NARROWINGS):
        if gap < radius:
            return share
        third = (high - low) / 3.0
        gap, _, _ = closest(shape, vec3.add_scaled(start, low + third, path))
        second_gap, _, _ = closest(shape, vec3.add_scaled(start, high - third, path))
        if gap < second_gap:
            high -= third
        else:
            low += third
            gap = second_gap
    return NO_HIT


@by_type_with_default
def meets(shape: Any, start: Vec3, end: Vec3, radius: float, in_contact: bool, budget: int) -> tuple[float, float, int]:
    """Return `travel`, the number of the element hit, and the remaining budget."""
    return travel(shape, start, end, radius, in_contact), 0.0, budget
