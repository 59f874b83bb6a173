"""One rolling step: where the contact goes when the fingertip turns without slipping.

    roll(method, shape, radius, center, normal, turn) -> center, normal, motion, theta

`turn` is the rotation of the fingertip against the object since the last tick (quaternion, world
frame, w >= 0). `motion` is the way the fingertip's centre rolled, (3,) m, tangent to the new normal.
"""

from typing import Any

from softfinger.proxy.kernels import rotations, vec3
from softfinger.proxy.kernels.dispatch import by_type
from softfinger.proxy.kernels.model import Coupling, EulerZxz, Quaternion, Vec3
from softfinger.proxy.kernels.surfaces import closest, relative_curvature, transport


@by_type
def roll(method: Any, shape: Any, radius: float, center: Vec3, normal: Vec3, turn: Quaternion) -> Any: ...


@by_type
def torque_stiffness(method: Any, coupling: Coupling) -> Any: ...


@roll.of(None)
def no_roll(
    method: None, shape: Any, radius: float, center: Vec3, normal: Vec3, turn: Quaternion
) -> tuple[Vec3, Vec3, Vec3, float]:
    """The contact stays; it is only put back onto the surface, so that rounding does not add up."""
    _, point, normal = closest(shape, center)
    return vec3.add_scaled(point, radius, normal), normal, (0.0, 0.0, 0.0), 0.0


@torque_stiffness.of(None)
def no_torque_stiffness(method: None, coupling: Coupling) -> float:
    return coupling.stiffness


@torque_stiffness.of(EulerZxz)
def torque_stiffness_of_euler_zxz(method: EulerZxz, coupling: Coupling) -> float:
    return method.torque_stiffness


@roll.of(EulerZxz)
def roll_euler_zxz(
    method: EulerZxz, shape: Any, radius: float, center: Vec3, normal: Vec3, turn: Quaternion
) -> tuple[Vec3, Vec3, Vec3, float]:
    """Rolling by the Euler angles of the step's rotation, read in the contact frame.

    The tilt theta turns the fingertip about an axis e of the tangent plane; the contact then travels
    delta s = theta / k_gamma along e x n, and the centre r theta along it.

    Source: Salvietti, Malvezzi, Prattichizzo (2013), Algorithm 1 and eq. 3. Differs from its eq. 2 in
    the heading: the paper's angles are those of ZXZ, whose axis half way through the step is
    (phi - psi) / 2, which is where the vector part of the quaternion points.
    """
    theta, axis = rotations.tilt(turn, normal)
    along = vec3.cross(axis, normal)
    point = vec3.add_scaled(center, -radius, normal)
    travel = theta / relative_curvature(shape, radius, point, normal, along)
    _, point, new_normal = closest(shape, vec3.add_scaled(point, travel, along))
    motion = transport(shape, vec3.scale(radius * theta, along), normal, new_normal)
    return vec3.add_scaled(point, radius, new_normal), new_normal, motion, theta
