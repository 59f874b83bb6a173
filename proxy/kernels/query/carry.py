"""Motion of an object in a tick, applied to its contact: points, directions, relative velocity and rotation.

Relative to a moving object, the fingertip's path in a tick starts at its last position moved along with the object.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Pose, Quaternion, Single, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3
from softfinger.proxy.kernels.numerics.frames import into, out_of, pose_values, turn_into, turn_out_of
from softfinger.proxy.kernels.query.container import find_object
from softfinger.proxy.kernels.query.motion import can_move


class Carry(NamedTuple):
    """Poses of an object in the last tick and now; `moves` is 0 if it cannot move.

    If the only object of a scene cannot move, None is used instead, and the functions below compile to nothing.
    """

    moves: float
    last: Pose
    current: Pose


@jit
def make_carry(body: Any) -> Any:
    """Return the motion of an object in this tick: a Carry, or None if it cannot move."""
    if body.motion is None:
        return None
    return Carry(can_move(body.motion), pose_values(body.last_pose), pose_values(body.pose))


@jit
def find_carry(objects: Any, index: float) -> Any:
    """Return the motion in this tick of the object with that index, as `make_carry`."""
    return make_carry(find_object(objects, index))


@jit
def has_moving_object(objects: Any) -> bool:
    """Return whether any object can move."""
    if isinstance(objects, Single):
        return can_move(objects.body.motion) > 0.0
    return objects.movable_count > 0.0


@jit
def move_point(carry: Any, x: Vec3) -> Vec3:
    """Return the current position (3,) m of a point that moves with the object, in the world frame."""
    if carry is None or carry.moves == 0.0:
        return x
    return out_of(carry.current, into(carry.last, x))


@jit
def turn_direction(carry: Any, v: Vec3) -> Vec3:
    """Return the current direction (3,) of a vector that turns with the object, in the world frame."""
    if carry is None or carry.moves == 0.0:
        return v
    return turn_out_of(carry.current, turn_into(carry.last, v))


@jit
def compute_relative_velocity(carry: Any, velocity: Vec3, position: Vec3, dt: float) -> Vec3:
    """Return `velocity` (3,) m/s relative to the object at `position` (3,) m of the last tick.

    With dt = 0 the object has no velocity.
    """
    if carry is None or carry.moves == 0.0 or dt <= 0.0:
        return velocity
    return vec3.add_scaled(velocity, -1.0 / dt, vec3.sub(move_point(carry, position), position))


@jit
def compute_relative_rotation(carry: Any, turn: Quaternion) -> Quaternion:
    """Return the fingertip's rotation `turn` relative to the rotation of the object in this tick, with w >= 0."""
    if carry is None or carry.moves == 0.0:
        return turn
    objects_turn = rotations.relative(carry.current.orientation, carry.last.orientation)
    return rotations.relative(turn, objects_turn)
