"""What all rolling methods share: their signature, their result, and standing still."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels import rotations, vec3
from softfinger.proxy.kernels.dispatch import by_type
from softfinger.proxy.kernels.jit import jit
from softfinger.proxy.kernels.model import (
    Coupling,
    EulerZxz,
    EulerZyx,
    Midpoint,
    MontanaRk4,
    MontanaRk45,
    Quaternion,
    RotationVector,
    Vec3,
)
from softfinger.proxy.kernels.surfaces import closest


class Roll(NamedTuple):
    """A rolling step, in the object's frame.

    center   (3,)  m    fingertip centre, at the distance r from the object
    normal   (3,)  1    unit normal under it
    motion   (3,)  m    how far the centre rolled: its path unrolled into the tangent plane at its end
    theta          rad  roll angle, |motion| / r
    spin           rad  rotation about the normal along the path
    """

    center: Vec3
    normal: Vec3
    motion: Vec3
    theta: float
    spin: float


@by_type
def roll(method: Any, shape: Any, radius: float, center: Vec3, normal: Vec3, turn: Quaternion) -> Any:
    """One rolling step.

    shape                the object, in whose frame everything is
    radius          m    of the fingertip, r
    center  (3,)    m    fingertip centre before the step
    normal  (3,)    1    unit normal under it
    turn    (4,)    1    rotation of the fingertip against the object since the last tick, w >= 0
    returns              Roll
    """


@by_type
def torque_stiffness(method: Any, coupling: Coupling) -> Any:
    """k_tau, N/m: force per length of roll that the hand has not followed."""


@jit
def land(shape: Any, radius: float, center: Vec3) -> tuple[Vec3, Vec3]:
    """The point of the offset surface nearest to `center`, and the unit normal there."""
    _, point, normal = closest(shape, center)
    return vec3.add_scaled(point, radius, normal), normal


@roll.of(None)
def no_roll(method: None, shape: Any, radius: float, center: Vec3, normal: Vec3, turn: Quaternion) -> Roll:
    """The contact stays; it is only put back onto the surface, so that rounding does not add up."""
    center, new_normal = land(shape, radius, center)
    return Roll(center, new_normal, (0.0, 0.0, 0.0), 0.0, rotations.twist(turn, normal))


@torque_stiffness.of(None)
def no_torque_stiffness(method: None, coupling: Coupling) -> float:
    return coupling.stiffness


def own_torque_stiffness(method: Any, coupling: Coupling) -> float:
    return method.torque_stiffness


for _method in (EulerZxz, EulerZyx, RotationVector, Midpoint, MontanaRk4, MontanaRk45):
    torque_stiffness.of(_method)(own_torque_stiffness)
