"""Signature and result of all rolling methods, the method None, and the dependence on the form of the fingertip."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.model import MinkowskiSum, Quaternion, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.shapes import BUDGET_OF_A_ROLL, closest, closest_from
from softfinger.proxy.kernels.shapes.minkowski import support_vector


class OffsetPoint(NamedTuple):
    """Point of the object's offset surface: the fingertip's centre (3,) m, and the unit normal of the object there."""

    center: Vec3
    normal: Vec3


class Roll(NamedTuple):
    """Result of a rolling step, in the object's frame.

    center   (3,)  m    fingertip centre, at the distance r from the object
    normal   (3,)  1    unit normal of the object there
    motion   (3,)  m    path of the centre, unrolled into the tangent plane at its end
    theta          rad  roll angle; of a ball |motion| / r
    spin           rad  rotation about the normal along the path
    is_complete         False if the budget was exhausted before the end of the path: only the angles are valid
    """

    center: Vec3
    normal: Vec3
    motion: Vec3
    theta: float
    spin: float
    is_complete: bool


@by_type
def roll(method: Any, shape: Any, radius: float, center: Vec3, normal: Vec3, turn: Quaternion) -> Any:
    """Compute one rolling step.

    shape                object; all vectors are in its frame
    radius          m    of the fingertip, r
    center  (3,)    m    fingertip centre before the step
    normal  (3,)    1    unit normal of the object there
    turn    (4,)    1    rotation of the fingertip relative to the object since the last tick, w >= 0
    returns              Roll
    """


@jit
def land(shape: Any, radius: float, center: Vec3) -> tuple[Vec3, Vec3]:
    """Return the point of the offset surface nearest to `center` (3,) m, and the unit normal there."""
    _, point, normal = closest(shape, center)
    return vec3.add_scaled(point, radius, normal), normal


@jit
def land_from(shape: Any, radius: float, start: Vec3, up: Vec3, center: Vec3) -> tuple[Vec3, Vec3]:
    """Return `land` after a roll from the centre `start` (3,) m, where the normal is `up` (3,)."""
    _, point, normal, _ = closest_from(shape, center, vec3.add_scaled(start, -radius, up), BUDGET_OF_A_ROLL)
    return vec3.add_scaled(point, radius, normal), normal


@roll.of(None)
def project_without_roll(method: None, shape: Any, radius: float, center: Vec3, normal: Vec3, turn: Quaternion) -> Roll:
    """Project the unmoved contact onto the surface, so that rounding does not accumulate."""
    center, new_normal = land_from(shape, radius, center, normal, center)
    return Roll(center, new_normal, (0.0, 0.0, 0.0), 0.0, rotations.twist(turn, normal), True)


# --- dependence on the form of the fingertip: an ellipsoid is part of the shape, a MinkowskiSum ---------------------


@jit
def rewind_shape(shape: Any, w: Vec3, remaining: float) -> Any:
    """Return the shape at the time when the fraction `remaining` of the tick's rotation vector `w` (3,) rad remains."""
    if not isinstance(shape, MinkowskiSum):
        return shape
    back = rotations.exp(vec3.scale(-remaining, w))
    return MinkowskiSum(shape.shape, shape.semi_axes, rotations.multiply(back, shape.orientation), shape.radius)


@jit
def compute_center_velocity(shape: Any, radius: float, w: Vec3, normal: Vec3) -> Vec3:
    """Return the velocity (3,) of the fingertip's centre in rolling without slip with the angular velocity `w`.

    It is w x arm, with the arm from the contact point to the centre. That of an ellipsoid has a component along the
    normal, too: the centre rises and falls.
    """
    if isinstance(shape, MinkowskiSum):
        return vec3.cross(w, support_vector(shape.semi_axes, shape.orientation, normal))
    return vec3.scale(radius, vec3.cross(w, normal))


@jit
def measure_surface_part(shape: Any, displacement: Vec3, normal: Vec3) -> float:
    """Return the length along the surface of a displacement (3,) m of the centre."""
    if isinstance(shape, MinkowskiSum):
        return vec3.norm(vec3.reject(displacement, normal))
    return vec3.norm(displacement)


@jit
def compute_roll_angle(shape: Any, radius: float, motion: Vec3, tilted: float) -> float:
    """Return the roll angle, rad, of a step with that `motion` (3,) m and `tilted`, the mean of |w x n|, rad."""
    return tilted if isinstance(shape, MinkowskiSum) else vec3.norm(motion) / radius
