"""Conversion of the wrench of the contact step into the commanded wrench; no wrench reaches a hand by another path.

In order: the soft wall of the workspace is added, the limits of energy and heat reduce the force, a handle that is too
fast gets zero force, and the guard is applied last. `tick.py` calls it for each finger.
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
    """State of the output: of the guard and of the limits."""

    guarded: Guarded
    limited: Limited


BEGUN: Final = Passed(DISENGAGED, COLD)


@jit
def felt(guard: Guard, given: Guarded) -> Guarded:
    """Return the part of a wrench that reaches the hand: without torque if the device cannot display one."""
    return Guarded(given.force, vec3.scale(guard.turns, given.torque), given.gain)


@jit
def observed(guard: Guard, passed: Passed, motion: Motion, mode: float, dt: float) -> Limited:
    """Return the state of the limits after a motion of the hand; limits that are off are not computed.

    mode  contact mode now
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
    """Apply all limits and the guard to a wrench.

    force, torque  (3,) N, N m  about the handle, from the contact step and the passivity controller
    motion                      of the fingertip since the last tick, under the wrench commanded then
    mode                        contact mode now
    returns        Passed with the wrench to command, and the guard's bits
    """
    limits, limited, bits = guard.limits, observed(guard, passed, motion, mode, instant.dt), 0
    if limits.workspace.radius < inf:
        push, out = wall_force(limits.workspace, handle_at(motion.tool, motion.now))
        if out:
            force, bits = vec3.add(force, push), WORKSPACE_EDGE
    share = share_of(limits, limited.given)
    if share < 1.0:  # scale the limits, too: a stiff wall requests many times their value and would still reach them
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
    """Return the state of the limits after a tick with zero force because it has no pose.

    The motors cool, and the wait after excess speed continues.
    """
    nothing = (0.0, 0.0, 0.0)
    heat, given = warmed(guard.limits, limited.heat, nothing, dt), remembered(limited.given, limited.work, dt)
    return Limited(nothing, limited.wait, heat, limited.work, given, 0.0)
