"""How a moving object takes its contact along: the point, the directions, and what the fingertip turned against it."""

from typing import Any, NamedTuple

from numba import literal_unroll

from softfinger.proxy.kernels import rotations
from softfinger.proxy.kernels.dispatch import by_type
from softfinger.proxy.kernels.frames import into, out_of, pose_values, turn_into, turn_out_of
from softfinger.proxy.kernels.jit import jit
from softfinger.proxy.kernels.model import Driven, Pose, Quaternion, Sinusoid, Turntable, Vec3


class Carry(NamedTuple):
    """How an object moved since the last tick; `moves` is 0 for one that cannot."""

    moves: float
    was: Pose
    now: Pose


@by_type
def can_move(motion: Any) -> Any:
    """1 for a motion that can change an object's pose."""


@can_move.of(None)
def cannot_move(motion: None) -> float:
    return 0.0


def moves(motion: Any) -> float:
    return 1.0


for _motion in (Sinusoid, Turntable, Driven):
    can_move.of(_motion)(moves)


@jit
def carry(objects: Any, index: float, was: Pose) -> Carry:
    """Motion of the object with that place in the tuple since it had the pose `was`."""
    moves, now = 0.0, was
    at = 0.0
    for body in literal_unroll(objects):
        if at == index:
            moves, now = can_move(body.motion), pose_values(body.pose)
        at += 1.0
    return Carry(moves, was, now)


@jit
def carried_point(carried: Carry, x: Vec3) -> Vec3:
    """A point of the object, (3,) m world, where it is now."""
    if carried.moves == 0.0:
        return x
    return out_of(carried.now, into(carried.was, x))


@jit
def carried_direction(carried: Carry, v: Vec3) -> Vec3:
    """A direction of the object, world, as it points now."""
    if carried.moves == 0.0:
        return v
    return turn_out_of(carried.now, turn_into(carried.was, v))


@jit
def turn_against(carried: Carry, turn: Quaternion) -> Quaternion:
    """The fingertip's rotation `turn` less the object's own, w >= 0: what it turned against the object."""
    if carried.moves == 0.0:
        return turn
    objects_turn = rotations.relative(carried.now.orientation, carried.was.orientation)
    return rotations.relative(turn, objects_turn)
