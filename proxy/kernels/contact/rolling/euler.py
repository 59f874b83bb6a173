"""Rolling by the Euler angles of the tick's rotation in the contact frame, as in the paper.

The paper can be read in two ways. Both convert the rotation of a tick to one roll about an axis e in the tangent plane,
and a spin about the normal. The centre then moves straight ahead along e x n: on the normal section of the offset
surface, approximated by the circle of the same curvature. So a rotation without spin is exact on planes, on spheres and
across edges. With spin the path deviates, see docs/model/rolling.md.

Source: Salvietti, Malvezzi, Prattichizzo (2013), Algorithm 1 and eqs. 2-7.
"""

from typing import Any

from softfinger.proxy.kernels.contact.rolling.base import Roll, land_from, roll
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import AnyShape, EulerZxz, EulerZyx, Quaternion, Sphere, Vec3
from softfinger.proxy.kernels.model.vectors import ZERO
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.shapes import ahead, curvature, transport
from softfinger.proxy.kernels.shapes.kernel_table import AHEAD, SLOTS, KernelSlot, call_kernel
from softfinger.proxy.kernels.shapes.round import offset_curvature

SLOTS[AHEAD] = KernelSlot(ahead, (0.0, ZERO, ZERO, ZERO), ZERO)


@ahead.of(AnyShape)
def any_ahead(shape: AnyShape, radius: float, center: Vec3, normal: Vec3, motion: Vec3) -> Vec3:
    if shape.kernels[AHEAD] != 0:
        return call_kernel(shape, AHEAD, ZERO, (radius, center, normal, motion))
    return round_ahead(shape, radius, center, normal, motion)


@jit
def move_on_circle(center: Vec3, normal: Vec3, motion: Vec3, k: float) -> Vec3:
    """Move from `center` (3,) m straight ahead by `motion` (3,) m on a circle of curvature `k`, 1/m."""
    square = vec3.dot(motion, motion)
    angle_square = k * k * square
    chord = rotations.sinc_of_root(0.25 * angle_square)
    moved = vec3.add_scaled(center, rotations.sinc_of_root(angle_square), motion)
    return vec3.add_scaled(moved, -0.5 * k * square * chord * chord, normal)


@ahead.of(Sphere)
def sphere_ahead(shape: Sphere, radius: float, center: Vec3, normal: Vec3, motion: Vec3) -> Vec3:
    return move_on_circle(center, normal, motion, offset_curvature(shape.radius, shape.side, radius))


@ahead.otherwise
def round_ahead(shape: Any, radius: float, center: Vec3, normal: Vec3, motion: Vec3) -> Vec3:
    """Move along the osculating circle of the normal section; k = k_1 cos^2 + k_2 sin^2 (Euler's formula)."""
    k1, k2, d1 = curvature(shape, radius, vec3.add_scaled(center, -radius, normal), normal)
    c, s = vec3.dot(motion, d1), vec3.dot(motion, vec3.cross(normal, d1))
    square = c * c + s * s
    k = (k1 * c * c + k2 * s * s) / square if square > 0.0 else 0.0
    return move_on_circle(center, normal, motion, k)


@jit
def roll_ahead(shape: Any, radius: float, center: Vec3, normal: Vec3, path: Vec3, spin: float) -> Roll:
    """Roll straight ahead; `path` (3,) is that of a ball of radius 1, see `rotations.roll_unit_ball`."""
    motion = vec3.scale(radius, path)
    moved = ahead(shape, radius, center, normal, motion)
    center, new_normal = land_from(shape, radius, center, normal, moved)
    return Roll(center, new_normal, transport(shape, motion, normal, new_normal), vec3.norm(path), spin, True)


@roll.of(EulerZxz)
def roll_euler_zxz(method: EulerZxz, shape: Any, radius: float, center: Vec3, normal: Vec3, turn: Quaternion) -> Roll:
    """Roll by the tilt theta about the heading at the middle of the step, with the spin phi + psi.

    Differs from the paper's eq. 2 in the heading: its eqs. 5-7 give the angles of ZXZ, with the heading (phi - psi) / 2
    at the middle of the step, which is the direction of the quaternion's vector part.
    """
    path, spin = rotations.roll_unit_ball(turn, normal), rotations.twist(turn, normal)
    return roll_ahead(shape, radius, center, normal, path, spin)


@roll.of(EulerZyx)
def roll_euler_zyx(method: EulerZyx, shape: Any, radius: float, center: Vec3, normal: Vec3, turn: Quaternion) -> Roll:
    """Roll by (delta psi, delta theta), with the spin delta phi: eqs. 2 and 3 with roll, pitch and yaw, as in the text.

    Like roll, pitch and yaw, the result depends on the tangent axes x, y (`rotations.tangent_frame`) in the second
    order of the rotation. This method is for comparison.
    """
    x, y = rotations.tangent_frame(normal)
    v = (turn[1], turn[2], turn[3])
    psi, pitch, phi = rotations.euler_zyx((turn[0], vec3.dot(v, x), vec3.dot(v, y), vec3.dot(v, normal)))
    path = vec3.add_scaled(vec3.scale(pitch, x), -psi, y)  # (psi x + pitch y) x n
    return roll_ahead(shape, radius, center, normal, path, phi)
