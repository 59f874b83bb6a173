"""One tick without its clock and devices: from poses to passive and guarded wrenches and records.

The servo loop and `simulate` both call it; for equal poses the results are equal to the bit.
"""

from typing import Any, Final, NamedTuple

from softfinger.proxy.kernels.contact.outcome import make_free_contact
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import map_each, replace, unzip
from softfinger.proxy.kernels.model import Contact, FingerState, Pose, Probe, Scene, State, World
from softfinger.proxy.kernels.numerics.rotations import as_unit
from softfinger.proxy.kernels.numerics.tool import about_handle, about_tip, tip_of
from softfinger.proxy.kernels.numerics.vec3 import norm
from softfinger.proxy.kernels.record_writer import write_contact, write_surfaces, write_vector
from softfinger.proxy.kernels.step import step
from softfinger.proxy.record import AT, POSITION_MAX_M, RECORD_SIZE
from softfinger.proxy.scene import start_state
from softfinger.server.loop.guard import INITIAL_GUARD_STATE, POSE_REFUSED, TOO_FAST, Guard, GuardState
from softfinger.server.loop.hand_limits import INITIAL_LIMITS, SPEED_TIME_CONSTANT_S, LimitState
from softfinger.server.loop.output import Instant, OutputState, cool_limits, limit_wrench, reduce_to_displayed
from softfinger.server.loop.passivity import NO_ENERGY, Energy, HandMotion, keep_passive
from softfinger.server.loop.reactions import collect_reactions, compute_relative_energy, make_no_reactions

UNMOVED: Final = (-0.0, -0.0, -0.0)
"""Offset that changes no bit of a sum, including the sign of a zero."""


class Tuning(NamedTuple):
    """All parameters that may change while the servo runs.

    guards     tuple of Guard, one for each finger of the scene
    passivity  Passivity or None, shared by all fingers
    tools      tuple of Tool or None, the tool of each finger's device
    offsets    tuple of (3,) m, added to the position from each device; used by the loop, not by the tick
    """

    scene: Scene
    guards: Any
    passivity: Any = None
    tools: Any = (None,)
    offsets: Any = (UNMOVED,)


class FingerMemory(NamedTuple):
    """State of one finger between ticks.

    contact      state of its contact
    guard_state  state of its guard
    energy       state of the passivity observer
    limit_state  state of the limits, preserved whenever the other parts are reset
    reactions    wrenches of its contacts on moving bodies, a tuple of Reaction; None in a scene without bodies
    """

    contact: FingerState
    guard_state: GuardState
    energy: Energy
    limit_state: LimitState = INITIAL_LIMITS
    reactions: Any = None


class Memory(NamedTuple):
    """State between ticks: the world, and a FingerMemory for each finger."""

    world: World
    fingers: Any


class Output(NamedTuple):
    """Stages of the output that all fingers share."""

    passivity: Any
    bodies: Any


def make_start_memory(scene: Scene) -> Memory:
    """Return the state before the first tick."""
    state = start_state(scene)
    fingers = tuple(
        FingerMemory(finger, INITIAL_GUARD_STATE, NO_ENERGY, INITIAL_LIMITS, make_no_reactions(scene.bodies, finger))
        for finger in state.fingers
    )
    return Memory(state.world, fingers)


def continue_memory(start: Memory, guards: tuple[Guard, ...], row: Any) -> Memory:
    """Return the state before the first tick of a loop that continues another one.

    row  records of the last tick, one finger after the other

    The limits continue from these records: new guards do not cool the motors or slow the handle.
    """
    fingers = []
    for index, (finger, guard) in enumerate(zip(start.fingers, guards, strict=True)):
        record = row[index * RECORD_SIZE :]
        wait = max(guard.limits.slow_s, SPEED_TIME_CONSTANT_S) if int(record[AT.servo_guard]) & TOO_FAST else 0.0
        limit_state = INITIAL_LIMITS._replace(
            wait=wait, heat=float(record[AT.limits_heat]), energy_given=float(record[AT.limits_energy])
        )
        fingers.append(finger._replace(limit_state=limit_state))
    return start._replace(fingers=tuple(fingers))


@jit
def reset_guard(start: FingerMemory, hand: FingerMemory) -> FingerMemory:
    """Return the state after the device displayed no force in spite of the command: the guard restarts."""
    return FingerMemory(hand.contact, start.guard_state, hand.energy, hand.limit_state, start.reactions)


@jit
def reset_contact(start: FingerMemory, hand: FingerMemory) -> FingerMemory:
    """Return the state of a finger that was displaced without a path: its contact restarts."""
    return FingerMemory(start.contact, hand.guard_state, hand.energy, hand.limit_state, start.reactions)


@jit
def continue_from_wrench(before: GuardState, hand: FingerMemory) -> FingerMemory:
    """Return the state after the device kept the wrench `before`: the slew limit continues from it."""
    guard_state = GuardState(before.force, before.torque, hand.guard_state.gain)
    return FingerMemory(hand.contact, guard_state, hand.energy, hand.limit_state, hand.reactions)


@jit
def record_wrench(tool: Any, guard_state: GuardState, record: Any) -> None:
    """Replace the wrench in a record by the one of the device; the pose remains."""
    at = AT.probe_orientation
    tip = (record[at], record[at + 1], record[at + 2], record[at + 3])
    write_vector(record, AT.force, guard_state.force)
    write_vector(record, AT.torque, about_tip(tool, tip, guard_state.force, guard_state.torque))


@jit
def has_pose(sample: Any) -> bool:
    """Return whether a device sample has a pose: finite, within reach, with a quaternion of approximately unit norm."""
    square = 0.0
    for i in range(3):
        if not abs(sample[i]) <= POSITION_MAX_M:
            return False
    for i in range(3, 7):
        square += sample[i] * sample[i]
    return 0.25 <= square <= 4.0  # False for NaN


@jit
def compute_pose(tool: Any, last: Probe, sample: Any) -> Pose:
    """Return the fingertip's pose for a sample of the handle; the last pose if the sample has none."""
    if has_pose(sample):
        position = (sample[0], sample[1], sample[2])
        return tip_of(tool, Pose(position, as_unit((sample[3], sample[4], sample[5], sample[6]))))
    return Pose(last.position, last.orientation)


@jit
def with_start_probe(world: World, finger: FingerState, pose: Pose) -> Any:
    """Return a finger's state before a tick.

    A finger without a previous pose, in a world that has already started, starts at its present pose; otherwise a
    moving body would act as if it had moved past the finger.
    """
    probe = finger.probe
    if finger.started == 0.0 and world.started != 0.0:
        probe = Probe(pose.position, pose.orientation, probe.velocity)
    return replace(finger, "probe", probe)


@jit
def read_pose(hand: FingerMemory, tool: Any, sample: Any, world: World) -> tuple[FingerState, Pose]:
    """Return the state and the pose of a finger before the step."""
    finger = hand.contact
    pose = compute_pose(tool, finger.probe, sample)
    return with_start_probe(world, finger, pose), pose


@jit
def make_pair(first: Any, second: Any) -> Any:
    return first, second


@jit
def compute_command(
    hand: FingerMemory,
    start: FingerMemory,
    sample: Any,
    stepped: tuple[FingerState, Contact],
    guard_and_tool: tuple[Guard, Any],
    record: Any,
    output: Output,
    instant: Instant,
) -> FingerMemory:
    """Return the FingerMemory of a finger after the step, with the wrench to be commanded."""
    (state, contact), (guard, tool), before = stepped, guard_and_tool, hand.contact
    if has_pose(sample):
        position, orientation = state.probe.position, state.probe.orientation
        now = Pose(position, orientation)
        last = Pose(before.probe.position, before.probe.orientation) if before.started != 0.0 else now
        motion = HandMotion(last, now, tool)
        energy = compute_relative_energy(output.passivity, output.bodies, hand.energy, hand.reactions)
        energy, force = keep_passive(
            output.passivity,
            energy,
            reduce_to_displayed(guard, hand.guard_state),
            motion,
            contact.mode,
            contact.force,
            instant.dt,
        )
        torque = about_handle(tool, orientation, force, contact.torque)
        output_state = OutputState(hand.guard_state, hand.limit_state)
        output_state, bits = limit_wrench(guard, output_state, motion, contact.mode, force, torque, instant)
        guard_state, limit_state = output_state.guard_state, output_state.limit_state
    else:
        position, orientation = before.probe.position, before.probe.orientation
        contact = make_free_contact(before, Probe(position, orientation, (0.0, 0.0, 0.0)), (0.0, 0.0, 0.0), 0.0)
        state, guard_state, energy, bits = start.contact, start.guard_state, start.energy, POSE_REFUSED
        limit_state = cool_limits(guard, hand.limit_state, instant.dt)
    torque = about_tip(tool, orientation, guard_state.force, guard_state.torque)
    write_contact(record, instant.number, instant.dt, position, orientation, contact, guard_state.force, torque)
    record[AT.servo_guard] = bits
    record[AT.passivity_energy] = energy.work
    record[AT.passivity_damping] = energy.damping
    record[AT.limits_speed] = norm(limit_state.velocity)
    record[AT.limits_heat] = limit_state.heat
    record[AT.limits_energy] = limit_state.energy_given
    displayed = reduce_to_displayed(guard, guard_state)
    displayed_at_tip = GuardState(
        displayed.force, about_tip(tool, orientation, displayed.force, displayed.torque), displayed.gain
    )
    reactions = collect_reactions(output.passivity, output.bodies, hand.reactions, contact, displayed_at_tip, position)
    return FingerMemory(state, guard_state, energy, limit_state, reactions)


@jit
def run_tick(
    tuning: Tuning, start: Memory, memory: Memory, samples: Any, dt: float, period: float, number: int, records: Any
) -> Memory:
    """Run contact step, passivity and guard of all fingers, and fill the contact part of their records.

    samples  a sample (position, quaternion, ...) of its handle for each finger; the wrench in the returned memory also
             acts at the handle, while the record has the wrench at the fingertip
    dt       s  time since the last tick
    period   s  nominal length of a tick
    records  a record for each finger

    A sample without a usable pose ends that finger's contact: zero force, its state as at the `start`, and a new ramp.
    The world and the other fingers continue.
    """
    fingers, poses = unzip(map_each(read_pose, (memory.fingers, tuning.tools, samples), memory.world))
    state, contacts = step(tuning.scene, State(memory.world, fingers), poses, dt)
    stepped = map_each(make_pair, (state.fingers, contacts))
    hands = map_each(
        compute_command,
        (memory.fingers, start.fingers, samples, stepped, map_each(make_pair, (tuning.guards, tuning.tools)), records),
        Output(tuning.passivity, tuning.scene.bodies),
        Instant(number, dt, period),
    )
    write_surfaces(state.world.surfaces, records)
    return Memory(state.world, hands)
