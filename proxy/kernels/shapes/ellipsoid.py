"""Ellipsoid of any proportions.

For the point p nearest to x, x - p is along the gradient: p_i = a_i^2 x_i / (a_i^2 + t), with t such that p is on
the surface. With c the shortest semi-axis, s = t + c^2 >= 0 and e_i = a_i^2 - c^2, this is

    sum q_i^2 = 1,  q_i = a_i |x_i| / (s + e_i),  p_i = a_i q_i

No close numbers are subtracted, so flat and needle-like ellipsoids lose no digits. Lengths are in units of c. The sum
is steep, but 1 / sqrt(sum) is concave and nearly straight in s: Newton's method on it increases s monotonically to the
root from any point to the left of it, and steps from the right to the left at once.

Sources: the equation is in Eberly, Distance from a point to an ellipse, an ellipsoid, or a hyperellipsoid (2013), with
bisection as solver; the step is that of Hebden (1973) and More (1978) for trust regions, where the same sum arises.
"""

from math import sqrt

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Ellipsoid, Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.shapes.protocol import (
    any_tangent,
    closest,
    compute_direction,
    compute_offset_curvature,
    curvature,
    may_be_hollow,
)

_MAX_STEPS = 128
"""Limit of Newton's iterations; close to the surface three or four are enough. It is needed at the rim of the medial
surface, off it by the smallest representable distance: there s grows by half per step, at worst from 1e-60 to 1e-40."""

_STEP_TOLERANCE = 1e-8
"""Relative step below which the next would be below rounding: the convergence is quadratic."""

_ZERO_COORDINATE = 1e-60
"""A coordinate below this multiple of the shortest semi-axis counts as zero: it moves the nearest point by at most its
cube root."""


@jit
def invert(weight: float, s: float) -> float:
    """Return 1 / s; 0 if its weight is zero, since s may then be zero."""
    return 1.0 / s if weight > 0.0 else 0.0


@jit
def multiply_components(a: Vec3, b: Vec3) -> Vec3:
    """Return the componentwise product."""
    return (a[0] * b[0], a[1] * b[1], a[2] * b[2])


@jit
def invert_each(w: Vec3, s: float, e: Vec3) -> Vec3:
    return (invert(w[0], s + e[0]), invert(w[1], s + e[1]), invert(w[2], s + e[2]))


@jit
def compute_weight(ratio: float, x: float) -> float:
    """Return ratio x; 0 if x counts as zero."""
    return ratio * x if x > _ZERO_COORDINATE else 0.0


@jit
def on_ellipsoid(axes: Vec3, shortest: float, x: Vec3) -> Vec3:
    """Return q (3,) of the nearest point, on the unit sphere, for `x` without negative coordinates."""
    a = (axes[0] / shortest, axes[1] / shortest, axes[2] / shortest)
    weights = (
        compute_weight(a[0], x[0] / shortest),
        compute_weight(a[1], x[1] / shortest),
        compute_weight(a[2], x[2] / shortest),
    )
    e = ((a[0] - 1.0) * (a[0] + 1.0), (a[1] - 1.0) * (a[1] + 1.0), (a[2] - 1.0) * (a[2] + 1.0))
    # Lower bound of the root: no q_i exceeds 1.
    least = max(0.0, weights[0] - e[0], weights[1] - e[1], weights[2] - e[2])
    # s = 1 is t = 0, the root for x on the surface; for x outside, the root is larger.
    s = max(least, 1.0)
    for count in range(_MAX_STEPS):
        inverted = invert_each(weights, s, e)
        q = multiply_components(weights, inverted)
        squares = multiply_components(q, q)
        slope = vec3.dot(squares, inverted)
        if slope <= 0.0:
            s = least
            break
        square = squares[0] + squares[1] + squares[2]
        advance = square * (sqrt(square) - 1.0) / slope
        s = max(least, s + advance)
        # Only the first step may be negative; a later one is rounding, which deep inside may exceed the tolerance.
        if abs(advance) <= _STEP_TOLERANCE * s or (count > 0 and advance <= 0.0):
            break
    q = multiply_components(weights, invert_each(weights, s, e))
    if s > 0.0:
        return vec3.scale(1.0 / vec3.norm(q), q)
    # x is in the plane of symmetry normal to the shortest axis, so deep that the other two components are inside.
    remainder = sqrt(max(1.0 - vec3.dot(q, q), 0.0))
    if axes[0] == shortest:
        return (remainder, q[1], q[2])
    if axes[1] == shortest:
        return (q[0], remainder, q[2])
    return (q[0], q[1], remainder)


may_be_hollow(Ellipsoid)


@closest.of(Ellipsoid)
def closest_on_ellipsoid(shape: Ellipsoid, x: Vec3) -> tuple[float, Vec3, Vec3]:
    """Of several nearest points, as at the centre, return the one on the positive side of the shortest axis."""
    a = shape.semi_axes
    sign = (
        1.0 if x[0] >= 0.0 else -1.0,
        1.0 if x[1] >= 0.0 else -1.0,
        1.0 if x[2] >= 0.0 else -1.0,
    )
    shortest = min(a[0], a[1], a[2])
    q = on_ellipsoid(a, shortest, (abs(x[0]), abs(x[1]), abs(x[2])))
    q = (sign[0] * q[0], sign[1] * q[1], sign[2] * q[2])
    point = (a[0] * q[0], a[1] * q[1], a[2] * q[2])
    # The gradient, in units of the shortest semi-axis.
    _, outward = compute_direction((q[0] * (shortest / a[0]), q[1] * (shortest / a[1]), q[2] * (shortest / a[2])), q)
    gap = shape.side * vec3.dot(vec3.sub(x, point), outward)
    return gap, point, vec3.scale(shape.side, outward)


@curvature.of(Ellipsoid)
def curvature_of_ellipsoid(shape: Ellipsoid, radius: float, point: Vec3, normal: Vec3) -> tuple[float, float, Vec3]:
    """Compute the principal curvatures from the normal only.

    W = h P diag(1 / a_i^2) P with P the projection to the tangent plane and h = sqrt(sum (a_i n_i)^2) the
    distance of the tangent plane from the centre; k1 >= k2 > 0, and k2 from the product h^4 / (a b c)^2, because
    on a needle the difference that gives it otherwise would consist of rounding.
    """
    a = shape.semi_axes
    h = vec3.norm((a[0] * normal[0], a[1] * normal[1], a[2] * normal[2]))
    u = any_tangent(normal)
    v = vec3.cross(normal, u)
    uu = h * ((u[0] / a[0]) * (u[0] / a[0]) + (u[1] / a[1]) * (u[1] / a[1]) + (u[2] / a[2]) * (u[2] / a[2]))
    vv = h * ((v[0] / a[0]) * (v[0] / a[0]) + (v[1] / a[1]) * (v[1] / a[1]) + (v[2] / a[2]) * (v[2] / a[2]))
    uv = h * (u[0] * v[0] / (a[0] * a[0]) + u[1] * v[1] / (a[1] * a[1]) + u[2] * v[2] / (a[2] * a[2]))
    half = 0.5 * (uu - vv)
    spread = sqrt(half * half + uv * uv)
    k1 = 0.5 * (uu + vv) + spread
    product = h / a[0] * (h / a[1]) * (h / (a[2] * a[0])) * (h / (a[1] * a[2]))
    k2 = product / k1
    # The eigenvector of k1 from the row that does not cancel; any tangent if the two are equal.
    along = (half + spread, uv, 0.0) if half >= 0.0 else (uv, spread - half, 0.0)
    _, turned = compute_direction(along, (1.0, 0.0, 0.0))
    first = vec3.add_scaled(vec3.scale(turned[0], u), turned[1], v)
    return compute_offset_curvature(shape.side * k1, radius), compute_offset_curvature(shape.side * k2, radius), first
