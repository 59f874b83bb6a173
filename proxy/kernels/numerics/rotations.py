"""Rotations as unit quaternions (w, x, y, z), body to world, and their decomposition into twist and tilt."""

from math import atan2, copysign, cos, hypot, sin, sqrt

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Quaternion, Vec3
from softfinger.proxy.kernels.numerics import vec3

SERIES_MAX = 0.1
"""Angles (rad) and tangents below this use a power series, which takes a fifth of the time of the library function. The
first omitted term is below 1e-17 of the sum. The rotation of one tick is rarely larger."""

UNIT_TO_ROUNDING = 8.0 * 2.0**-52
"""Largest computed deviation from 1 of the squared norm of a normalised quaternion.

Within it, a quaternion is not normalised again: reading a recorded one must not change a bit. With u = 2^-53, the sum
of squares has a relative error of at most 4 u; its root 3 u, with the root's rounding; the quotient 4 u; each component
5 u after the product, hence 10 u in the square; summed again 14 u = 7 eps, and one eps for terms of second order.
"""


@jit
def sinc_of_root(y: float) -> float:
    """Return sin(x) / x at x = sqrt(y), and 1 at 0.

    Terms of the series are added in pairs, as they do not depend on each other: a tick waits for the sum.
    """
    if y < SERIES_MAX * SERIES_MAX:
        return (1.0 - y * (1.0 / 6.0)) + (y * y) * (1.0 / 120.0 - y * (1.0 / 5040.0 - y * (1.0 / 362880.0)))
    x = sqrt(y)
    return sin(x) / x


@jit
def angle_of(s: float, c: float) -> float:
    """Return the angle (rad) of a rotation from sine and cosine of its half: 2 atan2(s, c), for c >= 0."""
    if abs(s) < SERIES_MAX * c:
        t = s / c
        y = t * t
        series = 1.0 / 7.0 - y * (1.0 / 9.0 - y * (1.0 / 11.0 - y * (1.0 / 13.0 - y * (1.0 / 15.0))))
        return 2.0 * t * (1.0 - y * (1.0 / 3.0 - y * (1.0 / 5.0 - y * series)))
    return 2.0 * atan2(s, c)


@jit
def conjugate(q: Quaternion) -> Quaternion:
    return (q[0], -q[1], -q[2], -q[3])


@jit
def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Return the Hamilton product a b: rotation `b` first, then `a`."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@jit
def about_x(angle: float) -> Quaternion:
    return (cos(0.5 * angle), sin(0.5 * angle), 0.0, 0.0)


@jit
def about_y(angle: float) -> Quaternion:
    return (cos(0.5 * angle), 0.0, sin(0.5 * angle), 0.0)


@jit
def about_z(angle: float) -> Quaternion:
    return (cos(0.5 * angle), 0.0, 0.0, sin(0.5 * angle))


@jit
def rotate(q: Quaternion, v: Vec3) -> Vec3:
    """Rotate `v` by `q`: v + 2 w (u x v) + 2 u x (u x v), u the vector part."""
    u = (q[1], q[2], q[3])
    t = vec3.scale(2.0, vec3.cross(u, v))
    return vec3.add(vec3.add_scaled(v, q[0], t), vec3.cross(u, t))


@jit
def normalize(q: Quaternion) -> Quaternion:
    """Return the unit quaternion along `q`, which must not be zero."""
    s = 1.0 / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (s * q[0], s * q[1], s * q[2], s * q[3])


@jit
def as_unit(q: Quaternion) -> Quaternion:
    """Normalise an input quaternion; return it unchanged, to the bit, if it is unit to rounding.

    Do not use it for products of rotations: their rounding errors would accumulate.
    """
    if abs(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3] - 1.0) <= UNIT_TO_ROUNDING:
        return q
    return normalize(q)


@jit
def from_matrix(m: tuple[Vec3, Vec3, Vec3]) -> Quaternion:
    """Return the unit quaternion, w >= 0, of the rotation matrix with rows `m`.

    Source: Shepperd (1978): the case of the largest component is used, so that no digits are lost by cancellation. Each
    case computes 4 q_max q; its normalisation also removes rounding errors of the matrix. A matrix that is not a
    rotation, NaN included, gives NaN or an unrelated rotation, never an error.
    """
    trace = m[0][0] + m[1][1] + m[2][2]
    if trace >= m[0][0] and trace >= m[1][1] and trace >= m[2][2]:
        q = (1.0 + trace, m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1])
    elif m[0][0] >= m[1][1] and m[0][0] >= m[2][2]:
        q = (m[2][1] - m[1][2], 1.0 + m[0][0] - m[1][1] - m[2][2], m[0][1] + m[1][0], m[0][2] + m[2][0])
    elif m[1][1] >= m[2][2]:
        q = (m[0][2] - m[2][0], m[0][1] + m[1][0], 1.0 - m[0][0] + m[1][1] - m[2][2], m[1][2] + m[2][1])
    else:
        q = (m[1][0] - m[0][1], m[0][2] + m[2][0], m[1][2] + m[2][1], 1.0 - m[0][0] - m[1][1] + m[2][2])
    if q[0] < 0.0:
        q = (-q[0], -q[1], -q[2], -q[3])
    return normalize(q)


@jit
def relative(q: Quaternion, q_before: Quaternion) -> Quaternion:
    """Return the shortest rotation (w >= 0) from `q_before` to `q` in world coordinates, dR = R R_before^T."""
    d = multiply(q, conjugate(q_before))
    if d[0] < 0.0:
        return (-d[0], -d[1], -d[2], -d[3])
    return d


@jit
def twist(q: Quaternion, n: Vec3) -> float:
    """Return the twist of the rotation `q`, w >= 0, about the unit axis `n`: rad, within +-pi.

    It is the sum phi + psi of the ZXZ Euler angles of `q` in any frame whose z axis is `n`.
    """
    return angle_of(q[1] * n[0] + q[2] * n[1] + q[3] * n[2], q[0])


@jit
def roll_unit_ball(q: Quaternion, n: Vec3) -> Vec3:
    """Return the motion of the centre of a ball of radius 1 that the unit quaternion `q` (w >= 0) rolls over a plane.

    n        (3,)  1    unit normal of the plane
    returns  (3,)  rad  theta e x n: tilt angle theta in [0, pi], e its unit axis in the plane

    With (w, v) the quaternion and z = v . n, the ZXZ angles of `q` in the contact frame satisfy
    |v x n| = sin(theta / 2), sqrt(w^2 + z^2) = cos(theta / 2), and v - z n points along the heading
    (phi - psi) / 2, which is the axis halfway through the step. The result does not depend on the choice of a contact
    frame, and theta = 0 is not singular. The ratio of theta to its sine is a series in the square of the sine, that of
    the arc sine: no root and no division, for which the tick would have to wait.
    """
    v = (q[1], q[2], q[3])
    across = vec3.cross(v, n)
    y = vec3.dot(across, across)
    if y < SERIES_MAX * SERIES_MAX:
        low = (2.0 + y * (1.0 / 3.0)) + (y * y) * (3.0 / 20.0 + y * (5.0 / 56.0))
        high = (35.0 / 576.0 + y * (63.0 / 1408.0)) + (y * y) * (231.0 / 6656.0 + y * (143.0 / 5120.0))
        return vec3.scale(low + (y * y) * (y * y) * high, across)
    s, z = sqrt(y), vec3.dot(v, n)
    return vec3.scale(angle_of(s, sqrt(q[0] * q[0] + z * z)) / s, across)


@jit
def exp(w: Vec3) -> Quaternion:
    """Return the unit quaternion of the rotation vector `w` (3,) rad."""
    square = 0.25 * vec3.dot(w, w)
    s = 0.5 * sinc_of_root(square)
    return (cos(sqrt(square)), s * w[0], s * w[1], s * w[2])


@jit
def log(q: Quaternion) -> Vec3:
    """Return the rotation vector (3,) rad, at most pi long, of the unit quaternion `q` with w >= 0."""
    v = (q[1], q[2], q[3])
    s = vec3.norm(v)
    return vec3.scale(angle_of(s, q[0]) / s if s > 0.0 else 2.0, v)


@jit
def tangent_frame(n: Vec3) -> tuple[Vec3, Vec3]:
    """Return unit vectors x, y such that x, y, n are right-handed; the world's x and y axes for n along +z.

    They are the world's axes after the smallest rotation from ez to n; for n_z < 0, the axes x, -y, -z after the
    smallest rotation from -ez to n. Continuous in each half-space, with a jump at n_z = 0.
    Source: Duff et al. (2017), Building an Orthonormal Basis, Revisited.
    """
    sign = -1.0 if n[2] < 0.0 else 1.0  # not copysign: a negative zero is in the upper half-space
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    return (1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), (b, sign + n[1] * n[1] * a, -n[1])


@jit
def euler_zyx(q: Quaternion) -> Vec3:
    """Return roll, pitch and yaw of the unit quaternion `q`: R = Rz(yaw) Ry(pitch) Rx(roll).

    returns  (3,)  rad  (psi about x, theta about y within +-pi/2, phi about z)

    At pitch +-pi/2 only the sum or difference of roll and yaw is defined; the yaw is then 0.
    """
    w, x, y, z = q
    r11, r21, r31 = w * w + x * x - y * y - z * z, 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)
    r32, r33 = 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z
    cosine = hypot(r11, r21)
    # r11 and r21 below rounding are noise: they would give a random yaw.
    if cosine < 1e-15:
        r12, r22 = 2.0 * (x * y - w * z), w * w - x * x + y * y - z * z
        return (atan2(copysign(1.0, -r31) * r12, r22), atan2(-r31, 0.0), 0.0)
    return (atan2(r32, r33), atan2(-r31, cosine), atan2(r21, r11))
