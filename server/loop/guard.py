"""The guard, last of the output before the device: every wrench passes, there is no way around.

In order: what is not finite becomes zero, the ramp after engaging, the clamp by norm (the direction
is kept), the limit on change per tick. The ramp scales the wrench and the limit of the clamp alike: else a stiff wall,
which asks for many times the limit, would give all of it after a few ticks.

Because the last output lies within the clamp and so does the new goal, every point between them does too, so the slew
limit cannot leave the clamp.

Ramp and slew limit go by ticks that happened, not by time gone by: a hand that was held up for five ticks
is given one tick's change after them, not five. After a pause longer than PAUSE_MAX_S, and after anything
that has zeroed the force (a refused pose, disarming, the driver itself), it comes up from zero again.
"""

from math import inf, isfinite
from typing import Final, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.server.loop.limits import UNLIMITED, Limits

GUARD_NAMES: Final = (
    "pose_refused", "not_finite", "ramping", "force_clamped", "torque_clamped", "slew_limited", "disarmed",
    "pose_jumped", "pose_frozen", "too_fast", "motor_hot", "energy_spent", "workspace_edge",
)  # fmt: skip
"""Name of each bit of `servo.guard`, lowest first."""
POSE_REFUSED: Final = 1
NOT_FINITE: Final = 2
RAMPING: Final = 4
FORCE_CLAMPED: Final = 8
TORQUE_CLAMPED: Final = 16
SLEW_LIMITED: Final = 32
DISARMED: Final = 64
POSE_JUMPED: Final = 128
POSE_FROZEN: Final = 256
TOO_FAST: Final = 512
MOTOR_HOT: Final = 1024
ENERGY_SPENT: Final = 2048
WORKSPACE_EDGE: Final = 4096


class Guard(NamedTuple):
    """Limits: N, N m, N/s, N m/s, s; `armed` 1 or 0. Of the poses that it believes: m/s, rad/s, and how long (s) one
    may repeat bit for bit under force, 0 for ever. `turns`: 1 where the hand is given the torque, 0 where it is not.
    `limits`: those that look back or at the place, which `output.py` applies before these."""

    force_max: float
    torque_max: float
    force_slew: float
    torque_slew: float
    ramp: float
    armed: float
    speed_max: float = inf
    turn_max: float = inf
    frozen: float = 0.0
    turns: float = 1.0
    limits: Limits = UNLIMITED


class Guarded(NamedTuple):
    """What the guard remembers: the last output (N, N m) and how far the ramp has come, 0 to 1."""

    force: Vec3
    torque: Vec3
    gain: float


NO_DIRECTION: Final = 1e-300
"""Largest component, N or N m, below which a vector cannot be divided by it."""

PAUSE_MAX_S: Final = 0.1
"""Longest time between two outputs that a force is carried over. Stalls of a host, 11 to 21 ms, are well below; a hand
answers after some 150 ms, so past this it no longer leans on the force that was held, and another would be a blow."""

DISENGAGED: Final = Guarded((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)


@jit
def finite(v: Vec3) -> bool:
    return isfinite(v[0]) and isfinite(v[1]) and isfinite(v[2])


@jit
def clamp(v: Vec3, largest: float) -> tuple[Vec3, bool]:
    """`v` with its norm brought down to `largest`, and whether that was needed.

    The largest component is divided out first: the square of a huge force overflows.
    """
    peak = max(abs(v[0]), abs(v[1]), abs(v[2]))
    if peak <= 0.5 * largest:  # the norm is at most sqrt(3) times the peak
        return v, False
    if peak < NO_DIRECTION:
        return (0.0, 0.0, 0.0), True
    unit = vec3.scale(1.0 / peak, v)
    size = peak * vec3.norm(unit)
    if size <= largest:
        return v, False
    return vec3.scale(largest / vec3.norm(unit), unit), True


@jit
def slew(before: Vec3, goal: Vec3, largest: float) -> tuple[Vec3, bool]:
    """The point at most `largest` from `before` towards `goal`, and whether it falls short."""
    step, limited = clamp(vec3.sub(goal, before), largest)
    if limited:
        return vec3.add(before, step), True
    return goal, False


@jit
def guard_wrench(
    guard: Guard, guarded: Guarded, force: Vec3, torque: Vec3, dt: float, period: float
) -> tuple[Guarded, int]:
    """Make a wrench safe to command.

    force, torque  (3,) N, N m  as the contact step computed them
    dt             s            time since the last output
    period         s            nominal length of a tick: what the ramp and the slew limit advance by
    returns        Guarded, whose force and torque are to be commanded, and the bits of what was changed
    """
    bits = 0
    zero = (0.0, 0.0, 0.0)
    if guard.armed == 0.0:
        return Guarded(zero, zero, 0.0), DISARMED
    if not (finite(force) and finite(torque)):
        return Guarded(zero, zero, 0.0), NOT_FINITE
    if not dt <= PAUSE_MAX_S:
        guarded = Guarded(zero, zero, 0.0)
    gain = min(guarded.gain + period / guard.ramp, 1.0) if guard.ramp > 0.0 else 1.0
    if gain < 1.0:
        bits |= RAMPING
        force, torque = vec3.scale(gain, force), vec3.scale(gain, torque)
    force, clamped = clamp(force, gain * guard.force_max)
    if clamped:
        bits |= FORCE_CLAMPED
    torque, clamped = clamp(torque, gain * guard.torque_max)
    if clamped:
        bits |= TORQUE_CLAMPED
    force, limited = slew(guarded.force, force, guard.force_slew * period)
    if limited:
        bits |= SLEW_LIMITED
    torque, limited = slew(guarded.torque, torque, guard.torque_slew * period)
    if limited:
        bits |= SLEW_LIMITED
    return Guarded(force, torque, gain), bits
