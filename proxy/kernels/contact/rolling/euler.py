"""Rolling by the Euler angles of the tick's rotation in the contact frame, as in the paper.

The paper can be read in two ways. Both convert the rotation of a tick to one roll about an axis e in the tangent plane,
and a spin about the normal. The centre then moves straight ahead along e x n: on the normal section of the offset
surface, approximated by the circle of the same curvature. So a rotation without spin is exact on planes, on spheres and
across edges. With spin the path deviates, see docs/model/rolling.md.

Source: Salvietti, Malvezzi, Prattichizzo (2013), Algorithm 1 and eqs. 2-7.
"""

from math import sqrt
from typing import Any

from softfinger.proxy.kernels.contact.rolling.base import Roll, land_from, roll
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import AnyShape, EulerZxz, EulerZyx, Quaternion, Vec3
from softfinger.proxy.kernels.model.vectors import ZERO
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.shapes import ahead, curvature, transport
from softfinger.proxy.kernels.shapes.kernel_table import AHEAD, SLOTS, KernelSlot, call_kernel

SLOTS[AHEAD] = KernelSlot(ahead, (0.0, ZERO, ZERO, ZERO, 0.0), ZERO)


@ahead.of(AnyShape)
def any_ahead(shape: AnyShape, radius: float, center: Vec3, normal: Vec3, along: Vec3, length: float) -> Vec3:
    if shape.kernels[AHEAD] != 0:
        return call_kernel(shape, AHEAD, ZERO, (radius, center, normal, along, length))
    return round_ahead(shape, radius, center, normal, along, length)


@ahead.otherwise
def round_ahead(shape: Any, radius: float, center: Vec3, normal: Vec3, along: Vec3, length: float) -> Vec3:
    """Move along the osculating circle of the normal section; k = k_1 cos^2 + k_2 sin^2 (Euler's formula)."""
    k1, k2, d1 = curvature(shape, radius, vec3.add_scaled(center, -radius, normal), normal)
    c, s = vec3.dot(along, d1), vec3.dot(along, vec3.cross(normal, d1))
    half = 0.5 * (k1 * c * c + k2 * s * s) * length
    chord = rotations.sinc(half)
    moved = vec3.add_scaled(center, length * rotations.sinc(2.0 * half), along)
    return vec3.add_scaled(moved, -length * half * chord * chord, normal)


@jit
def roll_about(
    shape: Any, radius: float, center: Vec3, normal: Vec3, axis: Vec3, theta: float, spin: float
) -> Roll:  # fmt: skip
    """Roll by `theta` rad about the unit tangent `axis`, which is zero if there is no roll."""
    along, length = vec3.cross(axis, normal), radius * theta
    moved = ahead(shape, radius, center, normal, along, length)
    center, new_normal = land_from(shape, radius, center, normal, moved)
    motion = transport(shape, vec3.scale(length, along), normal, new_normal)
    return Roll(center, new_normal, motion, theta, spin, True)


@roll.of(EulerZxz)
def roll_euler_zxz(method: EulerZxz, shape: Any, radius: float, center: Vec3, normal: Vec3, turn: Quaternion) -> Roll:
    """Roll by the tilt theta about the heading at the middle of the step, with the spin phi + psi.

    Differs from the paper's eq. 2 in the heading: its eqs. 5-7 give the angles of ZXZ, with the heading (phi - psi) / 2
    at the middle of the step, which is the direction of the quaternion's vector part.
    """
    theta, axis = rotations.tilt(turn, normal)
    return roll_about(shape, radius, center, normal, axis, theta, rotations.twist(turn, normal))


@roll.of(EulerZyx)
def roll_euler_zyx(method: EulerZyx, shape: Any, radius: float, center: Vec3, normal: Vec3, turn: Quaternion) -> Roll:
    """Roll by (delta psi, delta theta), with the spin delta phi: eqs. 2 and 3 with roll, pitch and yaw, as in the text.

    Like roll, pitch and yaw, the result depends on the tangent axes x, y (`rotations.tangent_frame`) in the second
    order of the rotation. This method is for comparison.
    """
    x, y = rotations.tangent_frame(normal)
    v = (turn[1], turn[2], turn[3])
    psi, pitch, phi = rotations.euler_zyx((turn[0], vec3.dot(v, x), vec3.dot(v, y), vec3.dot(v, normal)))
    theta = sqrt(psi * psi + pitch * pitch)
    axis = (0.0, 0.0, 0.0)
    if theta > 0.0:
        axis = vec3.add_scaled(vec3.scale(psi / theta, x), pitch / theta, y)
    return roll_about(shape, radius, center, normal, axis, theta, phi)
