"""Guard: last stage of the output before the device, which every wrench passes.

In order: a wrench that is not finite becomes zero; then follow the ramp after engaging, the clamp of the norm (the
direction is preserved), and the limit on the change per tick. The ramp scales both the wrench and the limit of the
clamp: a stiff wall requests many times the limit, and would otherwise reach the full limit after a few ticks.

The last output and the new goal both lie within the clamp, so every point between them does too, and the slew limit
cannot leave the clamp.

Ramp and slew limit count ticks, not elapsed time: after a delay of five ticks, the hand gets the change of one tick,
not of five. After a pause longer than PAUSE_MAX_S, and after any event that has zeroed the force (a refused pose,
disarming, the driver itself), the force rises from zero again.
"""

from math import inf, isfinite
from typing import Final, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.server.loop.hand_limits import UNLIMITED, Limits

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
    """Parameters of the guard.

    force_max        N
    torque_max       N m
    force_slew       N/s
    torque_slew      N m/s
    ramp             s
    armed                   1 or 0
    speed_max        m/s    largest plausible speed between poses
    turn_max         rad/s  largest plausible turn rate between poses
    frozen           s      time for which a pose may repeat exactly under force; 0 is unlimited
    displays_torque         1 if the device displays the torque, otherwise 0
    limits                  limits of history and position, applied before these by `output.py`
    """

    force_max: float
    torque_max: float
    force_slew: float
    torque_slew: float
    ramp: float
    armed: float
    speed_max: float = inf
    turn_max: float = inf
    frozen: float = 0.0
    displays_torque: float = 1.0
    limits: Limits = UNLIMITED


class GuardState(NamedTuple):
    """State of the guard: the last output (N, N m) and the gain of the ramp, 0 to 1."""

    force: Vec3
    torque: Vec3
    gain: float


NO_DIRECTION: Final = 1e-300
"""Largest component, N or N m, below which a vector cannot be divided by it."""

PAUSE_MAX_S: Final = 0.1
"""Longest time between two outputs over which a force is continued. Stalls of a host, 11 to 21 ms, are well below; a
hand responds after about 150 ms, so after a longer pause it no longer pushes against the old force, and a new force
would be a blow."""

INITIAL_GUARD_STATE: Final = GuardState((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0)


@jit
def is_finite(v: Vec3) -> bool:
    return isfinite(v[0]) and isfinite(v[1]) and isfinite(v[2])


@jit
def clamp(v: Vec3, largest: float) -> tuple[Vec3, bool]:
    """Return `v` with its norm clamped to `largest`, and whether it changed.

    It is divided by its largest component first, because the square of a huge force overflows.
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
def limit_slew(before: Vec3, goal: Vec3, largest: float) -> tuple[Vec3, bool]:
    """Return the point at most `largest` from `before` towards `goal`, and whether it falls short of the goal."""
    step, limited = clamp(vec3.sub(goal, before), largest)
    if limited:
        return vec3.add(before, step), True
    return goal, False


@jit
def guard_wrench(
    guard: Guard, guard_state: GuardState, force: Vec3, torque: Vec3, dt: float, period: float
) -> tuple[GuardState, int]:
    """Limit a wrench to one that is safe to command.

    force, torque  (3,) N, N m  from the contact step
    dt             s            time since the last output
    period         s            nominal length of a tick, by which the ramp and the slew limit advance
    returns        GuardState with the force and torque to command, and the bits of the changes
    """
    bits = 0
    zero = (0.0, 0.0, 0.0)
    if guard.armed == 0.0:
        return GuardState(zero, zero, 0.0), DISARMED
    if not (is_finite(force) and is_finite(torque)):
        return GuardState(zero, zero, 0.0), NOT_FINITE
    if not dt <= PAUSE_MAX_S:
        guard_state = GuardState(zero, zero, 0.0)
    gain = min(guard_state.gain + period / guard.ramp, 1.0) if guard.ramp > 0.0 else 1.0
    if gain < 1.0:
        bits |= RAMPING
        force, torque = vec3.scale(gain, force), vec3.scale(gain, torque)
    force, clamped = clamp(force, gain * guard.force_max)
    if clamped:
        bits |= FORCE_CLAMPED
    torque, clamped = clamp(torque, gain * guard.torque_max)
    if clamped:
        bits |= TORQUE_CLAMPED
    force, limited = limit_slew(guard_state.force, force, guard.force_slew * period)
    if limited:
        bits |= SLEW_LIMITED
    torque, limited = limit_slew(guard_state.torque, torque, guard.torque_slew * period)
    if limited:
        bits |= SLEW_LIMITED
    return GuardState(force, torque, gain), bits
