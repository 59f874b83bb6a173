"""Plausibility checks of a device's poses: jumps that no hand makes, and poses that repeat while a hand moves.

In both cases the position of the hand is unknown, so the force is zero. A driver cannot detect this from a single
sample; the loop compares successive ticks. `tick.has_pose` rejects poses that are not finite. Called by
`all_devices.py`.
"""

from math import cos, pi
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.drivers.base import OK
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.server.loop.guard import POSE_FROZEN, POSE_JUMPED, Guard
from softfinger.server.loop.tick import has_pose

POSE_SIZE: Final = 7
_AGE: Final = POSE_SIZE
_REPEATED: Final = POSE_SIZE + 1

LOADED_N: Final = 0.01
"""Force below which a repeated pose is harmless, since the hand does not feel it."""


def make_pose_memory() -> NDArray[np.float64]:
    """Return the memory of `check_pose` before the first pose.

    Contains the last pose (7,), the time (s) since it was fresh, and the time (s) for which it has repeated.
    """
    memory = np.zeros(POSE_SIZE + 2)
    memory[:POSE_SIZE] = np.nan
    return memory


@jit
def check_pose(guard: Guard, memory: NDArray[np.float64], raw: Any, status: int, force: Vec3, dt: float) -> int:
    """Return the guard's bit for an implausible pose: POSE_JUMPED, POSE_FROZEN, or 0.

    memory  memory of this device, from `make_pose_memory`
    raw     sample from the driver, which starts with position (m) and quaternion
    status  status of the read; unless it is OK, the pose may be the previous one, and its age continues to grow
    force   (3,) N  on the hand since the last tick
    dt      s       time since then
    """
    memory[_AGE] += dt
    if not has_pose(raw):
        memory[_REPEATED] = 0.0
        return 0
    same = True
    for i in range(POSE_SIZE):
        same &= raw[i] == memory[i]
    if same:
        if status == OK:
            memory[_AGE] = 0.0
        return _check_repeated(guard, memory, force, dt)
    jumps = _has_jumped(guard, memory, raw)
    for i in range(POSE_SIZE):
        memory[i] = raw[i]
    memory[_AGE] = memory[_REPEATED] = 0.0
    return POSE_JUMPED if jumps else 0


@jit
def _check_repeated(guard: Guard, memory: NDArray[np.float64], force: Vec3, dt: float) -> int:
    if guard.frozen == 0.0:
        return 0
    # A frozen pose turns the force off, so it remains frozen until the pose changes.
    if memory[_REPEATED] > guard.frozen or vec3.norm(force) >= LOADED_N:
        memory[_REPEATED] += dt
    else:
        memory[_REPEATED] = 0.0
    return POSE_FROZEN if memory[_REPEATED] > guard.frozen else 0


@jit
def _has_jumped(guard: Guard, memory: NDArray[np.float64], raw: Any) -> bool:
    """Return whether a pose is farther from the last one than the limits allow; False for the first pose."""
    displacement = (raw[0] - memory[0], raw[1] - memory[1], raw[2] - memory[2])
    if vec3.norm(displacement) > guard.speed_max * memory[_AGE]:
        return True
    half = 0.5 * guard.turn_max * memory[_AGE]
    if half >= 0.5 * pi:
        return False
    dot, before, now = 0.0, 0.0, 0.0
    for i in range(3, POSE_SIZE):
        dot += raw[i] * memory[i]
        before += memory[i] * memory[i]
        now += raw[i] * raw[i]
    return dot * dot < cos(half) ** 2 * before * now
