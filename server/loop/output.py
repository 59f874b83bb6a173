"""Conversion of the wrench of the contact step into the commanded wrench; no wrench reaches a hand by another path.

In order: the soft wall of the workspace is added, the limits of energy and heat reduce the force, a handle that is too
fast gets zero force, and the guard is applied last. `tick.py` calls it for each finger.
"""

from math import inf
from typing import Final, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import replace
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.record import FREE
from softfinger.server.loop.guard import (
    ENERGY_SPENT,
    INITIAL_GUARD_STATE,
    MOTOR_HOT,
    TOO_FAST,
    WORKSPACE_EDGE,
    Guard,
    GuardState,
    clamp,
    guard_wrench,
)
from softfinger.server.loop.hand_limits import (
    INITIAL_LIMITS,
    LimitState,
    compute_energy_scale,
    compute_heat_limit,
    compute_remaining_wait,
    compute_wall_force,
    decay_energy,
    smooth_velocity,
    update_heat,
    update_work,
)
from softfinger.server.loop.passivity import HandMotion, compute_work_on_hand, handle_at


class Instant(NamedTuple):
    """Number of a tick, time since the last one (s), and the nominal length of a tick (s)."""

    number: int
    dt: float
    period: float


class OutputState(NamedTuple):
    """State of the output: of the guard and of the limits."""

    guard_state: GuardState
    limit_state: LimitState


INITIAL_OUTPUT: Final = OutputState(INITIAL_GUARD_STATE, INITIAL_LIMITS)


@jit
def reduce_to_displayed(guard: Guard, wrench: GuardState) -> GuardState:
    """Return the part of a wrench that reaches the hand: without torque if the device cannot display one."""
    return GuardState(wrench.force, vec3.scale(guard.displays_torque, wrench.torque), wrench.gain)


@jit
def update_limits(guard: Guard, output_state: OutputState, motion: HandMotion, mode: float, dt: float) -> LimitState:
    """Return the state of the limits after a motion of the hand; limits that are off are not computed.

    mode  contact mode now
    """
    limits, before = guard.limits, output_state.limit_state
    velocity, work, energy_given, touches = before.velocity, before.work, before.energy_given, mode != FREE
    if limits.speed < inf:
        displacement = vec3.sub(handle_at(motion.tool, motion.now), handle_at(motion.tool, motion.before))
        velocity = smooth_velocity(velocity, displacement, dt)
    if limits.energy < inf:
        touched = before.touching != 0.0
        tick_work = (
            compute_work_on_hand(reduce_to_displayed(guard, output_state.guard_state), motion) if touched else 0.0
        )
        work = update_work(work, tick_work, touched, touches, dt)
        energy_given = decay_energy(energy_given, work, dt)
    return LimitState(velocity, before.wait, before.heat, work, energy_given, 1.0 if touches else 0.0)


@jit
def limit_wrench(
    guard: Guard,
    output_state: OutputState,
    motion: HandMotion,
    mode: float,
    force: Vec3,
    torque: Vec3,
    instant: Instant,
) -> tuple[OutputState, int]:
    """Apply all limits and the guard to a wrench.

    force, torque  (3,) N, N m  about the handle, from the contact step and the passivity controller
    motion                      of the fingertip since the last tick, under the wrench commanded then
    mode                        contact mode now
    returns        OutputState with the wrench to command, and the guard's bits
    """
    limits, limit_state, bits = guard.limits, update_limits(guard, output_state, motion, mode, instant.dt), 0
    if limits.workspace.radius < inf:
        push, out = compute_wall_force(limits.workspace, handle_at(motion.tool, motion.now))
        if out:
            force, bits = vec3.add(force, push), WORKSPACE_EDGE
    share = compute_energy_scale(limits, limit_state.energy_given)
    if share < 1.0:  # scale the limits, too: a stiff wall requests many times their value and would still reach them
        force, _ = clamp(vec3.scale(share, force), share * guard.force_max)
        torque, _ = clamp(vec3.scale(share, torque), share * guard.torque_max)
        bits |= ENERGY_SPENT
    allowed = compute_heat_limit(limits, limit_state.heat, guard.force_max)
    if allowed < guard.force_max:
        force, reduced = clamp(force, allowed)
        if reduced:
            bits |= MOTOR_HOT
    wait = compute_remaining_wait(
        limits, limit_state.wait, vec3.norm(limit_state.velocity), guard.armed != 0.0, instant.period
    )
    guard_state, changed = guard_wrench(guard, output_state.guard_state, force, torque, instant.dt, instant.period)
    if wait > 0.0:
        nothing = (0.0, 0.0, 0.0)
        guard_state, changed = GuardState(nothing, nothing, 0.0), changed | TOO_FAST
    heat = update_heat(limits, limit_state.heat, guard_state.force, instant.dt)
    return OutputState(guard_state, replace(limit_state, "wait", wait, "heat", heat)), changed | bits


@jit
def cool_limits(guard: Guard, limit_state: LimitState, dt: float) -> LimitState:
    """Return the state of the limits after a tick with zero force because it has no pose.

    The motors cool, and the wait after excess speed continues.
    """
    nothing = (0.0, 0.0, 0.0)
    heat = update_heat(guard.limits, limit_state.heat, nothing, dt)
    energy_given = decay_energy(limit_state.energy_given, limit_state.work, dt)
    return LimitState(nothing, limit_state.wait, heat, limit_state.work, energy_given, 0.0)
