"""From the wrench of the contact step to the one that is commanded: the only way to a hand.

In order: the soft wall of the workspace is added; energy and heat take from the force; a handle that is too fast gets
none; the guard has the last word.
"""

from math import inf
from typing import Final, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.record import FREE
from softfinger.server.loop.guard import (
    DISENGAGED,
    ENERGY_SPENT,
    MOTOR_HOT,
    TOO_FAST,
    WORKSPACE_EDGE,
    Guard,
    Guarded,
    clamp,
    guard_wrench,
)
from softfinger.server.loop.limits import (
    COLD,
    Limited,
    coolest,
    owed,
    remembered,
    share_of,
    smoothed,
    waiting,
    wall_force,
    warmed,
)
from softfinger.server.loop.passivity import Motion, handle_at, work_on_hand


class Instant(NamedTuple):
    """Number of a tick, time since the last one (s), and the nominal length of a tick (s)."""

    number: int
    dt: float
    period: float


class Passed(NamedTuple):
    """What the output remembers: of the guard, of the limits."""

    guarded: Guarded
    limited: Limited


BEGUN: Final = Passed(DISENGAGED, COLD)


@jit
def felt(guard: Guard, given: Guarded) -> Guarded:
    """What of a wrench a hand is given: no torque where the device displays none, whatever it senses."""
    return Guarded(given.force, vec3.scale(guard.turns, given.torque), given.gain)


@jit
def observed(guard: Guard, passed: Passed, motion: Motion, mode: float, dt: float) -> Limited:
    """What the limits remember once the hand has moved; no more than is asked for is computed.

    mode  of the contact now
    """
    limits, before = guard.limits, passed.limited
    velocity, work, most, touches = before.velocity, before.work, before.given, mode != FREE
    if limits.speed < inf:
        moved = vec3.sub(handle_at(motion.tool, motion.now), handle_at(motion.tool, motion.before))
        velocity = smoothed(velocity, moved, dt)
    if limits.energy < inf:
        touched = before.touching != 0.0
        given = work_on_hand(felt(guard, passed.guarded), motion) if touched else 0.0
        work = owed(work, given, touched, touches, dt)
        most = remembered(most, work, dt)
    return Limited(velocity, before.wait, before.heat, work, most, 1.0 if touches else 0.0)


@jit
def output_wrench(
    guard: Guard, passed: Passed, motion: Motion, mode: float, force: Vec3, torque: Vec3, instant: Instant
) -> tuple[Passed, int]:
    """Make a wrench one to command.

    force, torque  (3,) N, N m  about the handle, as contact step and passivity controller have it
    motion                      of the fingertip since the last tick, under the wrench that was commanded then
    mode                        of the contact now
    returns        Passed, whose wrench is to be commanded, and the guard's bits
    """
    limits, limited, bits = guard.limits, observed(guard, passed, motion, mode, instant.dt), 0
    if limits.workspace.radius < inf:
        push, out = wall_force(limits.workspace, handle_at(motion.tool, motion.now))
        if out:
            force, bits = vec3.add(force, push), WORKSPACE_EDGE
    share = share_of(limits, limited.given)
    if share < 1.0:  # of the limits, too: else a stiff wall, which asks for many times those, would keep all of them
        force, _ = clamp(vec3.scale(share, force), share * guard.force_max)
        torque, _ = clamp(vec3.scale(share, torque), share * guard.torque_max)
        bits |= ENERGY_SPENT
    allowed = coolest(limits, limited.heat, guard.force_max)
    if allowed < guard.force_max:
        force, reduced = clamp(force, allowed)
        if reduced:
            bits |= MOTOR_HOT
    wait = waiting(limits, limited.wait, vec3.norm(limited.velocity), guard.armed != 0.0, instant.period)
    guarded, changed = guard_wrench(guard, passed.guarded, force, torque, instant.dt, instant.period)
    if wait > 0.0:
        nothing = (0.0, 0.0, 0.0)
        guarded, changed = Guarded(nothing, nothing, 0.0), changed | TOO_FAST
    heat = warmed(limits, limited.heat, guarded.force, instant.dt)
    velocity, work, given, touching = limited.velocity, limited.work, limited.given, limited.touching
    return Passed(guarded, Limited(velocity, wait, heat, work, given, touching)), changed | bits


@jit
def at_rest(guard: Guard, limited: Limited, dt: float) -> Limited:
    """What the limits remember after a tick without a pose, which has no force: the motors cool, and what was too fast
    waits on."""
    nothing = (0.0, 0.0, 0.0)
    heat, given = warmed(guard.limits, limited.heat, nothing, dt), remembered(limited.given, limited.work, dt)
    return Limited(nothing, limited.wait, heat, limited.work, given, 0.0)
