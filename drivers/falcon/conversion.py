"""Dimensions of the Falcon's delta, and conversion of its replies to samples and of forces to motor counts.

The world has x to the right, y away from the user, z up; the device x to the right, y up, z towards the user.

Source: the dimensions of libnifalcon; `kinematics.delta` has the equations.
"""

from __future__ import annotations

from math import cos, nan, pi, sin
from typing import Final

from softfinger.drivers.base import FORCE_OFF, OK, SAMPLE_BUTTONS, SAMPLE_TIME
from softfinger.drivers.falcon import packets
from softfinger.drivers.falcon.block import AT
from softfinger.drivers.kinematics.delta import Delta, compute_torques, forward
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.memory import float64_at, int64_at, uint8_at
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3

RAD_PER_COUNT: Final = 0.01425 / 0.110 * 2.0 * pi / 1280.0
"""Leg angle per encoder count: ratio of drum to leg radius, counts per turn of the motor."""
THETA_ZERO: Final = 35.0 * pi / 180.0
"""Leg angle (rad) at encoder count 0."""

_LEGS: Final = (105.0 * pi / 180.0, -15.0 * pi / 180.0, -135.0 * pi / 180.0)
HOME: Final = (0.0, 0.0, 0.11)
"""m: initial value of a search without a last solution; within every leg's reach."""
FALCON: Final = Delta(
    arm=0.060,
    rod=0.1025,
    end=0.01443,
    joints=0.0225,
    shift=-0.025,
    base=0.0400,
    offset=-0.02309,
    cos=(cos(_LEGS[0]), cos(_LEGS[1]), cos(_LEGS[2])),
    sin=(sin(_LEGS[0]), sin(_LEGS[1]), sin(_LEGS[2])),
    home=HOME,
    origin=(0.0, 0.0, 0.0),
)


@jit
def process_byte(handle: int, byte: int) -> bool:
    """Process one byte of the device's stream; return True if it completes a reply, stored in the field `newest`."""
    word = int64_at(handle)
    fill, garbled = packets.assemble(byte, word[AT.fill], uint8_at(handle + 8 * AT.packet))
    if garbled:
        word[AT.garbled] += 1
    word[AT.fill] = fill
    if fill < packets.SIZE:
        return False
    word[AT.fill] = 0
    word[AT.newest], word[AT.newest + 1] = word[AT.packet], word[AT.packet + 1]
    word[AT.replies] += 1
    if uint8_at(handle + 8 * AT.newest)[packets.FILLER] != packets.BASE:
        word[AT.fillers] += 1
    if word[AT.unanswered] > 0:
        word[AT.unanswered] -= 1
    return True


@jit
def _to_world(v: Vec3) -> Vec3:
    """Convert from the device's frame (right, up, towards the user) to the world's (right, away from the user, up)."""
    return (v[0], -v[2], v[1])


@jit
def _to_device(v: Vec3) -> Vec3:
    return (v[0], v[2], -v[1])


@jit
def convert_reply(handle: int) -> int:
    """Convert the latest reply to the sample; return OK, or FORCE_OFF if the device has lost its homing.

    If no position has these counts, the sample is NaN, and the guard sets the force to zero.
    """
    word = int64_at(handle)
    counts, state = packets.decode(uint8_at(handle + 8 * AT.newest))
    homed = state & packets.HOMED
    word[AT.homed] = homed
    if word[AT.lights] & packets.HOMING == 0 and word[AT.armed] != 0:
        if homed == packets.HOMED:
            word[AT.was_homed] = 1
        elif word[AT.was_homed] != 0:
            return FORCE_OFF
    for k in range(3):
        word[AT.counts + k] = counts[k]
    at = float64_at(handle + 8 * AT.position)
    angle = (
        THETA_ZERO + RAD_PER_COUNT * counts[0],
        THETA_ZERO + RAD_PER_COUNT * counts[1],
        THETA_ZERO + RAD_PER_COUNT * counts[2],
    )
    p, converged = forward(FALCON, angle, (at[0], at[1], at[2]))
    last_sample = float64_at(handle + 8 * AT.sample)
    if converged:
        centre = float64_at(handle + 8 * AT.centre)
        knob_position = _to_world(vec3.sub(p, (centre[0], centre[1], centre[2])))
    else:
        word[AT.unreached] += 1
        p, knob_position = HOME, (nan, nan, nan)
    for k in range(3):
        at[k], last_sample[k] = p[k], knob_position[k]
    last_sample[SAMPLE_TIME] = (word[AT.sampled_at] - word[AT.opened_at]) * 1e-9
    last_sample[SAMPLE_BUTTONS] = float(state & packets.BUTTONS)
    return OK


@jit
def compute_motor_counts(gain: float, knob_position: Vec3, force: Vec3) -> tuple[packets.Counts, bool]:
    """Return motor counts (3,) for a force (3,) N, device's frame, at `knob_position`, and True if they were limited.

    If a count exceeds the maximum, all three are scaled down, so that the force keeps its direction.
    """
    torque, exists = compute_torques(FALCON, knob_position, force)
    counts = vec3.scale(gain, torque)
    largest = max(abs(counts[0]), max(abs(counts[1]), abs(counts[2])))
    is_limited = not exists
    if largest > packets.COUNT_MAX:
        counts = vec3.scale(packets.COUNT_MAX / largest, counts)
        is_limited = True
    return (round(counts[0]), round(counts[1]), round(counts[2])), is_limited


@jit
def compute_command(handle: int, force: Vec3) -> tuple[packets.Counts, bool]:
    """Return motor counts (3,) for a force (3,) N, world frame, at the present position, and True if it was limited."""
    at = float64_at(handle + 8 * AT.position)
    return compute_motor_counts(float64_at(handle + 8 * AT.gain)[0], (at[0], at[1], at[2]), _to_device(force))
