"""Rotations as unit quaternions (w, x, y, z), body to world, and their split about an axis."""

from math import atan2, sqrt

from softfinger.proxy.kernels import vec3
from softfinger.proxy.kernels.jit import jit
from softfinger.proxy.kernels.model import Quaternion, Vec3


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
    return 2.0 * atan2(q[1] * n[0] + q[2] * n[1] + q[3] * n[2], q[0])


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
    theta = 2.0 * atan2(s, sqrt(q[0] * q[0] + z * z))
    if s > 0.0:
        return theta, vec3.scale(1.0 / s, t)
    return 0.0, (0.0, 0.0, 0.0)
