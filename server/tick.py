"""One tick without its clock and device: pose in, passive and guarded wrench and record out.

The servo loop and `simulate` both run this, on the same poses to the same bits.
"""

from math import isfinite
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels import vec3
from softfinger.proxy.kernels.jit import jit
from softfinger.proxy.kernels.model import Scene, State
from softfinger.proxy.kernels.record import write_contact
from softfinger.proxy.kernels.rotations import normalize
from softfinger.proxy.kernels.step import out_of_contact, step
from softfinger.proxy.scene import start_state
from softfinger.proxy.state import OFFSET, POSITION_MAX_M
from softfinger.server.guard import DISENGAGED, POSE_REFUSED, Guard, Guarded, guard_wrench
from softfinger.server.passivity import NO_ENERGY, Energy, keep_passive

GUARD = OFFSET["servo.guard"]
ENERGY = OFFSET["passivity.energy"]
DAMPING = OFFSET["passivity.damping"]


class Tuning(NamedTuple):
    """Everything that may change while the servo runs; `passivity` is a Passivity or None."""

    scene: Scene
    guard: Guard
    passivity: Any = None


class Memory(NamedTuple):
    """Everything a tick leaves for the next: the contact's state, the guard's, the energy so far."""

    contact: State
    guarded: Guarded
    energy: Energy


def begin(scene: Scene) -> Memory:
    """Memory before the first tick."""
    return Memory(start_state(scene), DISENGAGED, NO_ENERGY)


@jit
def usable(sample: NDArray[np.float64]) -> bool:
    """Whether a device sample holds a pose: finite, within reach, a quaternion that is about unit."""
    square = 0.0
    for i in range(3):
        if not abs(sample[i]) <= POSITION_MAX_M:
            return False
    for i in range(3, 7):
        if not isfinite(sample[i]):
            return False
        square += sample[i] * sample[i]
    return 0.25 <= square <= 4.0


@jit
def tick(
    tuning: Tuning,
    start: Memory,
    memory: Memory,
    sample: NDArray[np.float64],
    dt: float,
    number: int,
    record: NDArray[np.float64],
) -> Memory:
    """Contact step, passivity and guard for one sample (position, quaternion, ...); fills the contact part of `record`.

    A sample without a usable pose ends the contact: force zero, everything as at the `start`, the ramp anew.
    """
    if usable(sample):
        position = (sample[0], sample[1], sample[2])
        orientation = normalize((sample[3], sample[4], sample[5], sample[6]))
        state, contact = step(tuning.scene, memory.contact, position, orientation, dt)
        moved = (0.0, 0.0, 0.0)
        if memory.contact.started != 0.0:
            moved = vec3.sub(position, memory.contact.position)
        energy, force = keep_passive(
            tuning.passivity, memory.energy, memory.guarded.force, moved, contact.mode, contact.force, dt
        )
        guarded, bits = guard_wrench(tuning.guard, memory.guarded, force, contact.torque, dt)
    else:
        position, orientation = memory.contact.position, memory.contact.orientation
        _, contact = out_of_contact(
            tuning.scene, tuning.scene.objects, memory.contact, position, orientation, (0.0, 0.0, 0.0), 0.0
        )
        state, guarded, energy, bits = start.contact, start.guarded, start.energy, POSE_REFUSED
    write_contact(record, number, dt, position, orientation, contact, guarded.force, guarded.torque)
    record[GUARD] = bits
    record[ENERGY] = energy.work
    record[DAMPING] = energy.damping
    return Memory(state, guarded, energy)
