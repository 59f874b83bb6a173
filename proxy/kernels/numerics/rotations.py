"""Rotations as unit quaternions (w, x, y, z), body to world, and their split about an axis."""

from math import atan2, copysign, cos, hypot, sin, sqrt

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Quaternion, Vec3
from softfinger.proxy.kernels.numerics import vec3

SMALL = 0.1
"""Below this a tangent or an angle (rad) is put into a power series, a fifth of the time of the library's call. The
first term left out is below 1e-17 of the sum; the rotation of one tick is hardly ever larger."""

UNIT_TO_ROUNDING = 8.0 * 2.0**-52
"""How far from 1 the sum of the squares of a quaternion that was normalised may be computed: else a recorded one would
be changed by a bit when it is read. With u = 2^-53: the sum is wrong by 4 u at most, the root of that and its own
rounding make 3 u, the quotient 4 u, the product 5 u of each component, so 10 u of the square; and it is summed again:
14 u = 7 eps, and one more for terms of second order."""


@jit
def sinc(x: float) -> float:
    """sin(x) / x, and 1 at 0."""
    if abs(x) < SMALL:
        y = x * x
        return 1.0 - y * (1.0 / 6.0 - y * (1.0 / 120.0 - y * (1.0 / 5040.0 - y * (1.0 / 362880.0))))
    return sin(x) / x


@jit
def angle_of(s: float, c: float) -> float:
    """Angle (rad) of a rotation from the sine and the cosine of its half: 2 atan2(s, c), for c >= 0."""
    if abs(s) < SMALL * c:
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
    """Hamilton product: `b` first, then `a`."""
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
    """Coordinates of `v` after the rotation `q`: v + 2 w (u x v) + 2 u x (u x v), u the vector part."""
    u = (q[1], q[2], q[3])
    t = vec3.scale(2.0, vec3.cross(u, v))
    return vec3.add(vec3.add_scaled(v, q[0], t), vec3.cross(u, t))


@jit
def normalize(q: Quaternion) -> Quaternion:
    """Unit quaternion along `q`; `q` must not be zero."""
    s = 1.0 / sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    return (s * q[0], s * q[1], s * q[2], s * q[3])


@jit
def as_unit(q: Quaternion) -> Quaternion:
    """`normalize` of what is read: a quaternion that is unit to rounding stays as it is, to the bit. Not for a product
    of rotations, whose rounding would come together over many."""
    if abs(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3] - 1.0) <= UNIT_TO_ROUNDING:
        return q
    return normalize(q)


@jit
def from_matrix(m: tuple[Vec3, Vec3, Vec3]) -> Quaternion:
    """Unit quaternion, w >= 0, of the rotation matrix with rows `m`; rounding in the matrix is taken out.

    Source: Shepperd (1978): the largest of the four components is found by a root, the others by division, so that
    none is lost to cancellation. A matrix that is no rotation, NaN included, gives a quaternion of NaN or one that
    turns something else; it never fails.
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
    """Rotation from `q_before` to `q` in world coordinates, dR = R R_before^T, the short way (w >= 0)."""
    d = multiply(q, conjugate(q_before))
    if d[0] < 0.0:
        return (-d[0], -d[1], -d[2], -d[3])
    return d


@jit
def twist(q: Quaternion, n: Vec3) -> float:
    """Angle (rad, within +-pi) of the part of the rotation `q`, w >= 0, about the unit axis `n`.

    The sum phi + psi of the ZXZ Euler angles of `q` in any frame whose z axis is `n`.
    """
    return angle_of(q[1] * n[0] + q[2] * n[1] + q[3] * n[2], q[0])


@jit
def tilt(q: Quaternion, n: Vec3) -> tuple[float, Vec3]:
    """Roll of the rotation `q` (w >= 0) over a tangent plane.

    n        (3,)  1    unit normal of the tangent plane
    returns  rad, (3,)  tilt angle theta in [0, pi] and its unit axis in the tangent plane
                        (zero when there is no tilt)

    With (w, v) the quaternion and z = v . n, the ZXZ angles of `q` in the contact frame satisfy
    |v - z n| = sin(theta / 2), sqrt(w^2 + z^2) = cos(theta / 2), and v - z n points along the heading
    (phi - psi) / 2, which is the axis half way through the step. No frame has to be chosen, and theta = 0
    is not singular.
    """
    v = (q[1], q[2], q[3])
    z = vec3.dot(v, n)
    t = vec3.add_scaled(v, -z, n)
    s = vec3.norm(t)
    theta = angle_of(s, sqrt(q[0] * q[0] + z * z))
    if s > 0.0:
        return theta, vec3.scale(1.0 / s, t)
    return 0.0, (0.0, 0.0, 0.0)


@jit
def exp(w: Vec3) -> Quaternion:
    """Unit quaternion of the rotation vector `w` (3,) rad."""
    half = 0.5 * vec3.norm(w)
    s = 0.5 * sinc(half)
    return (cos(half), s * w[0], s * w[1], s * w[2])


@jit
def log(q: Quaternion) -> Vec3:
    """Rotation vector (3,) rad of the unit quaternion `q` with w >= 0; its length is at most pi."""
    v = (q[1], q[2], q[3])
    s = vec3.norm(v)
    return vec3.scale(angle_of(s, q[0]) / s if s > 0.0 else 2.0, v)


@jit
def tangent_frame(n: Vec3) -> tuple[Vec3, Vec3]:
    """Unit vectors x, y with x, y, n right-handed; for n along +z the axes x and y themselves.

    The world's axes turned with ez to n the short way; where n points down, the axes x, -y, -z turned with
    -ez to n. Continuous in each half-space, with a jump at n_z = 0. Source: Duff et al. (2017), Building an
    Orthonormal Basis, Revisited.
    """
    sign = copysign(1.0, n[2])
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    return (1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0]), (b, sign + n[1] * n[1] * a, -n[1])


@jit
def euler_zyx(q: Quaternion) -> Vec3:
    """Roll, pitch, yaw of the unit quaternion `q`: R = Rz(yaw) Ry(pitch) Rx(roll).

    returns  (3,)  rad  (psi about x, theta about y within +-pi/2, phi about z)

    At pitch +-pi/2 roll and yaw are one angle; all of it is then given to the roll.
    """
    w, x, y, z = q
    r11, r21, r31 = w * w + x * x - y * y - z * z, 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)
    r32, r33 = 2.0 * (y * z + w * x), w * w - x * x - y * y + z * z
    cosine = hypot(r11, r21)
    # Below rounding r11 and r21 are noise, and their direction would be a random yaw.
    if cosine < 1e-15:
        r12, r22 = 2.0 * (x * y - w * z), w * w - x * x + y * y - z * z
        return (atan2(copysign(1.0, -r31) * r12, r22), atan2(-r31, 0.0), 0.0)
    return (atan2(r32, r33), atan2(-r31, cosine), atan2(r21, r11))
