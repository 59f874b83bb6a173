"""What all rolling methods share: their signature, their result, and standing still."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.model import MinkowskiSum, Quaternion, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.shapes import BUDGET_OF_A_ROLL, closest, closest_from
from softfinger.proxy.kernels.shapes.minkowski import support_vector


class OffsetPoint(NamedTuple):
    """A point of the object's offset surface: where the fingertip's centre (3,) m is, and the unit normal under it."""

    center: Vec3
    normal: Vec3


class Roll(NamedTuple):
    """A rolling step, in the object's frame.

    center   (3,)  m    fingertip centre, at the distance r from the object
    normal   (3,)  1    unit normal under it
    motion   (3,)  m    how far the centre rolled: its path unrolled into the tangent plane at its end
    theta          rad  roll angle; of a ball |motion| / r
    spin           rad  rotation about the normal along the path
    whole               False where the budget was used up on the way: then nothing but the angles counts
    """

    center: Vec3
    normal: Vec3
    motion: Vec3
    theta: float
    spin: float
    whole: bool


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


@jit
def land(shape: Any, radius: float, center: Vec3) -> tuple[Vec3, Vec3]:
    """The point of the offset surface nearest to `center`, and the unit normal there."""
    _, point, normal = closest(shape, center)
    return vec3.add_scaled(point, radius, normal), normal


@jit
def land_from(shape: Any, radius: float, start: Vec3, up: Vec3, center: Vec3) -> tuple[Vec3, Vec3]:
    """The same after a roll from `start` (3,) m, with the normal `up` (3,) there."""
    _, point, normal, _ = closest_from(shape, center, vec3.add_scaled(start, -radius, up), BUDGET_OF_A_ROLL)
    return vec3.add_scaled(point, radius, normal), normal


@roll.of(None)
def no_roll(method: None, shape: Any, radius: float, center: Vec3, normal: Vec3, turn: Quaternion) -> Roll:
    """The contact stays; it is only put back onto the surface, so that rounding does not add up."""
    center, new_normal = land_from(shape, radius, center, normal, center)
    return Roll(center, new_normal, (0.0, 0.0, 0.0), 0.0, rotations.twist(turn, normal), True)


# --- what of it depends on the fingertip's form: that of an ellipsoid is in the shape that it sees ------------------


@by_type
def earlier(shape: Any, w: Vec3, left: float) -> Any:
    """The shape as it is seen while the share `left` of the tick's rotation vector `w` (3,) rad is still to come."""


@by_type
def center_velocity(shape: Any, radius: float, w: Vec3, normal: Vec3) -> Any:
    """Velocity (3,) of the fingertip's centre while it rolls without slip at the angular velocity `w`: w x arm."""


@by_type
def surface_part(shape: Any, way: Vec3, normal: Vec3) -> Any:
    """Length of a way (3,) of the centre along the surface."""


@by_type
def roll_angle(shape: Any, radius: float, motion: Vec3, tilted: float) -> Any:
    """Roll, rad, of a step that rolled by `motion` (3,) m, and whose mean of |w x n| is `tilted` rad."""


@earlier.otherwise
def seen_the_same(shape: Any, w: Vec3, left: float) -> Any:
    return shape


@center_velocity.otherwise
def center_velocity_of_ball(shape: Any, radius: float, w: Vec3, normal: Vec3) -> Vec3:
    return vec3.scale(radius, vec3.cross(w, normal))


@surface_part.otherwise
def all_along_the_surface(shape: Any, way: Vec3, normal: Vec3) -> float:
    return vec3.norm(way)


@roll_angle.otherwise
def roll_angle_of_ball(shape: Any, radius: float, motion: Vec3, tilted: float) -> float:
    return vec3.norm(motion) / radius


@earlier.of(MinkowskiSum)
def turned_less(shape: MinkowskiSum, w: Vec3, left: float) -> MinkowskiSum:
    back = rotations.exp(vec3.scale(-left, w))
    return MinkowskiSum(shape.shape, shape.semi_axes, rotations.multiply(back, shape.orientation), shape.radius)


@center_velocity.of(MinkowskiSum)
def center_velocity_of_ellipsoid(shape: MinkowskiSum, radius: float, w: Vec3, normal: Vec3) -> Vec3:
    """Not along the surface alone: the centre rises and falls."""
    return vec3.cross(w, support_vector(shape.semi_axes, shape.orientation, normal))


@surface_part.of(MinkowskiSum)
def part_along_the_surface(shape: MinkowskiSum, way: Vec3, normal: Vec3) -> float:
    return vec3.norm(vec3.reject(way, normal))


@roll_angle.of(MinkowskiSum)
def roll_angle_of_ellipsoid(shape: MinkowskiSum, radius: float, motion: Vec3, tilted: float) -> float:
    return tilted
