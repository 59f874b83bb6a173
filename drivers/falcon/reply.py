"""Replies into samples, forces into motor counts: what stands between the Falcon's packets and the contract.

The world has x to the right, y away from the user, z up; the device x to the right, y up, z out to the user.
"""

from __future__ import annotations

from math import nan

from softfinger.drivers.base import FORCE_OFF, OK, SAMPLE_BUTTONS, SAMPLE_TIME
from softfinger.drivers.falcon import block, delta, packets
from softfinger.proxy.kernels import vec3
from softfinger.proxy.kernels.jit import jit
from softfinger.proxy.kernels.memory import float64_at, int64_at, uint8_at
from softfinger.proxy.kernels.model import Vec3


@jit
def feed(handle: int, byte: int) -> bool:
    """Take one byte of the device's stream; whether it ends a reply, which is then in NEWEST."""
    word = int64_at(handle)
    fill, garbled = packets.assemble(byte, word[block.FILL], uint8_at(handle + 8 * block.PACKET))
    if garbled:
        word[block.GARBLED] += 1
    word[block.FILL] = fill
    if fill < packets.SIZE:
        return False
    word[block.FILL] = 0
    word[block.NEWEST], word[block.NEWEST + 1] = word[block.PACKET], word[block.PACKET + 1]
    word[block.REPLIES] += 1
    if word[block.AWAITED] > 0:
        word[block.AWAITED] -= 1
    return True


@jit
def _to_world(v: Vec3) -> Vec3:
    """Device's frame (right, up, out to the user) to the world's (right, away from the user, up)."""
    return (v[0], -v[2], v[1])


@jit
def _to_device(v: Vec3) -> Vec3:
    return (v[0], v[2], -v[1])


@jit
def pose(handle: int) -> int:
    """The newest reply as the sample: OK, or FORCE_OFF when the device has lost its homing.

    Counts to which no place belongs give NaN, which the guard answers with zero force.
    """
    word = int64_at(handle)
    counts, state = packets.decode(uint8_at(handle + 8 * block.NEWEST))
    homed = state & packets.HOMED
    word[block.HOMED] = homed
    if word[block.LIGHTS] & packets.HOMING == 0 and word[block.ARMED] != 0:
        if homed == packets.HOMED:
            word[block.STAYS_HOMED] = 1
        elif word[block.STAYS_HOMED] != 0:
            return FORCE_OFF
    for k in range(3):
        word[block.COUNTS + k] = counts[k]
    at = float64_at(handle + 8 * block.POSITION)
    angle = (
        delta.THETA_ZERO + delta.RAD_PER_COUNT * counts[0],
        delta.THETA_ZERO + delta.RAD_PER_COUNT * counts[1],
        delta.THETA_ZERO + delta.RAD_PER_COUNT * counts[2],
    )
    p, found = delta.forward(angle, (at[0], at[1], at[2]))
    kept = float64_at(handle + 8 * block.SAMPLE)
    if found:
        centre = float64_at(handle + 8 * block.CENTRE)
        place = _to_world(vec3.sub(p, (centre[0], centre[1], centre[2])))
    else:
        word[block.UNREACHED] += 1
        p, place = delta.HOME, (nan, nan, nan)
    for k in range(3):
        at[k], kept[k] = p[k], place[k]
    kept[SAMPLE_TIME] = (word[block.HEARD_AT] - word[block.OPENED_AT]) * 1e-9
    kept[SAMPLE_BUTTONS] = float(state & packets.BUTTONS)
    return OK


@jit
def motor_counts(gain: float, place: Vec3, force: Vec3) -> tuple[packets.Counts, bool]:
    """Motor counts (3,) for a force (3,) N in the device's frame with the knob at `place`, and whether it was limited.

    A count past the largest brings all three down, so that the force keeps its direction.
    """
    torque, able = delta.torques_for(place, force)
    counts = vec3.scale(gain, torque)
    most = max(abs(counts[0]), max(abs(counts[1]), abs(counts[2])))
    cut = not able
    if most > packets.COUNT_MAX:
        counts = vec3.scale(packets.COUNT_MAX / most, counts)
        cut = True
    return (round(counts[0]), round(counts[1]), round(counts[2])), cut


@jit
def command(handle: int, force: Vec3) -> tuple[packets.Counts, bool]:
    """Motor counts (3,) for a force (3,) N in the world's frame where the knob is now, and whether it was limited."""
    at = float64_at(handle + 8 * block.POSITION)
    return motor_counts(float64_at(handle + 8 * block.GAIN)[0], (at[0], at[1], at[2]), _to_device(force))
