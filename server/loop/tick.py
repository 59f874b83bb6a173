"""One tick without its clock and devices: poses in, passive and guarded wrenches and records out.

The servo loop and `simulate` both run this, on the same poses to the same bits.
"""

from math import isfinite
from typing import Any, Final, NamedTuple

from softfinger.proxy.kernels.contact.outcome import report_free
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import map_each, replace, unzip
from softfinger.proxy.kernels.model import Contact, FingerState, Pose, Probe, Scene, State, World
from softfinger.proxy.kernels.numerics.rotations import as_unit
from softfinger.proxy.kernels.numerics.tool import about_handle, about_tip, tip_of
from softfinger.proxy.kernels.numerics.vec3 import norm
from softfinger.proxy.kernels.record_writer import put3, write_contact
from softfinger.proxy.kernels.step import step
from softfinger.proxy.record import AT, POSITION_MAX_M, RECORD_SIZE
from softfinger.proxy.scene import start_state
from softfinger.server.loop.guard import DISENGAGED, POSE_REFUSED, TOO_FAST, Guard, Guarded
from softfinger.server.loop.limits import COLD, SPEED_S, Limited
from softfinger.server.loop.output import Instant, Passed, at_rest, felt, output_wrench
from softfinger.server.loop.passivity import NO_ENERGY, Energy, Motion, keep_passive
from softfinger.server.loop.reactions import no_reactions, reactions_of, relative_energy

UNMOVED: Final = (-0.0, -0.0, -0.0)
"""An offset that changes no bit of what it is added to, a zero's sign included."""


class Tuning(NamedTuple):
    """Everything that may change while the servo runs.

    guards     tuple of Guard, one for each of the scene's fingers
    passivity  Passivity or None, of all of them
    tools      tuple of Tool or None, what each finger's device holds
    offsets    tuple of (3,) m, what is added to the position that each device says; the loop's, of no tick
    """

    scene: Scene
    guards: Any
    passivity: Any = None
    tools: Any = (None,)
    offsets: Any = (UNMOVED,)


class FingerMemory(NamedTuple):
    """What a tick leaves for the next of one finger: its contact's state, the guard's, the energy so far, and that of
    the limits, which lasts whatever becomes of the others; and what its contacts give to bodies that move, a tuple of
    Reaction, or None in a scene without."""

    contact: FingerState
    guarded: Guarded
    energy: Energy
    limited: Limited = COLD
    reactions: Any = None


class Memory(NamedTuple):
    """Everything a tick leaves for the next: the world, and a FingerMemory for each finger."""

    world: World
    fingers: Any


class Output(NamedTuple):
    """Passivity and bodies of all fingers, which their wrenches depend on."""

    passivity: Any
    bodies: Any


def begin(scene: Scene) -> Memory:
    """Memory before the first tick."""
    state = start_state(scene)
    fingers = tuple(
        FingerMemory(finger, DISENGAGED, NO_ENERGY, COLD, no_reactions(scene.bodies, finger))
        for finger in state.fingers
    )
    return Memory(state.world, fingers)


def carried_over(start: Memory, guards: tuple[Guard, ...], row: Any) -> Memory:
    """Memory before the first tick of a loop that takes over after a tick with these records, one after the other: new
    guards do not cool the motors, nor slow the handle."""
    fingers = []
    for place, (finger, guard) in enumerate(zip(start.fingers, guards, strict=True)):
        record = row[place * RECORD_SIZE :]
        wait = max(guard.limits.slow_s, SPEED_S) if int(record[AT.servo_guard]) & TOO_FAST else 0.0
        limited = COLD._replace(wait=wait, heat=float(record[AT.limits_heat]), given=float(record[AT.limits_energy]))
        fingers.append(finger._replace(limited=limited))
    return start._replace(fingers=tuple(fingers))


@jit
def let_go(start: FingerMemory, hand: FingerMemory) -> FingerMemory:
    """What is remembered after the hand was given no force, whatever was commanded: the guard's begins anew."""
    return FingerMemory(hand.contact, start.guarded, hand.energy, hand.limited, start.reactions)


@jit
def elsewhere(start: FingerMemory, hand: FingerMemory) -> FingerMemory:
    """What is remembered of a finger that is somewhere else now, without a way there: its contact begins anew."""
    return FingerMemory(start.contact, hand.guarded, hand.energy, hand.limited, start.reactions)


@jit
def held(before: Guarded, hand: FingerMemory) -> FingerMemory:
    """What is remembered after the hand was left the force of `before`: the guard counts on from that one."""
    guarded = Guarded(before.force, before.torque, hand.guarded.gain)
    return FingerMemory(hand.contact, guarded, hand.energy, hand.limited, hand.reactions)


@jit
def record_wrench(tool: Any, guarded: Guarded, record: Any) -> None:
    """Put another wrench of the device into a record whose pose stands."""
    at = AT.probe_orientation
    tip = (record[at], record[at + 1], record[at + 2], record[at + 3])
    put3(record, AT.force, guarded.force)
    put3(record, AT.torque, about_tip(tool, tip, guarded.force, guarded.torque))


@jit
def usable(sample: Any) -> bool:
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
def pose_of(tool: Any, last: Probe, sample: Any) -> Pose:
    """The fingertip's pose by a sample of the handle; the last one where it holds none."""
    if usable(sample):
        position = (sample[0], sample[1], sample[2])
        return tip_of(tool, Pose(position, as_unit((sample[3], sample[4], sample[5], sample[6]))))
    return Pose(last.position, last.orientation)


@jit
def entered(world: World, finger: FingerState, pose: Pose) -> Any:
    """A finger's state before a tick. One without a pose before, in a world that has gone on, has been where it is:
    else a body that moves would be felt as if it had moved past."""
    probe = finger.probe
    if finger.started == 0.0 and world.started != 0.0:
        probe = Probe(pose.position, pose.orientation, probe.velocity)
    return replace(finger, "probe", probe)


@jit
def arrive(hand: FingerMemory, tool: Any, sample: Any, world: World) -> tuple[FingerState, Pose]:
    """Before the step: a finger's state, and its pose."""
    finger = hand.contact
    pose = pose_of(tool, finger.probe, sample)
    return entered(world, finger, pose), pose


@jit
def command(
    hand: FingerMemory, start: FingerMemory, sample: Any, state: FingerState, contact: Contact, guard: Guard, tool: Any,
    record: Any, output: Output, instant: Instant,
) -> FingerMemory:  # fmt: skip
    """After the step, the FingerMemory of one finger with the wrench to be commanded."""
    before = hand.contact
    if usable(sample):
        position, orientation = state.probe.position, state.probe.orientation
        now = Pose(position, orientation)
        was = Pose(before.probe.position, before.probe.orientation) if before.started != 0.0 else now
        motion = Motion(was, now, tool)
        energy = relative_energy(output.passivity, output.bodies, hand.energy, hand.reactions)
        energy, force = keep_passive(
            output.passivity, energy, felt(guard, hand.guarded), motion, contact.mode, contact.force, instant.dt
        )
        torque = about_handle(tool, orientation, force, contact.torque)
        passed = Passed(hand.guarded, hand.limited)
        passed, bits = output_wrench(guard, passed, motion, contact.mode, force, torque, instant)
        guarded, limited = passed.guarded, passed.limited
    else:
        position, orientation = before.probe.position, before.probe.orientation
        contact = report_free(before, Probe(position, orientation, (0.0, 0.0, 0.0)), (0.0, 0.0, 0.0), 0.0)
        state, guarded, energy, bits = start.contact, start.guarded, start.energy, POSE_REFUSED
        limited = at_rest(guard, hand.limited, instant.dt)
    torque = about_tip(tool, orientation, guarded.force, guarded.torque)
    write_contact(record, instant.number, instant.dt, position, orientation, contact, guarded.force, torque)
    record[AT.servo_guard] = bits
    record[AT.passivity_energy] = energy.work
    record[AT.passivity_damping] = energy.damping
    record[AT.limits_speed] = norm(limited.velocity)
    record[AT.limits_heat] = limited.heat
    record[AT.limits_energy] = limited.given
    shown = felt(guard, guarded)
    given = Guarded(shown.force, about_tip(tool, orientation, shown.force, shown.torque), shown.gain)
    reactions = reactions_of(output.passivity, output.bodies, hand.reactions, contact, given, position)
    return FingerMemory(state, guarded, energy, limited, reactions)


@jit
def tick(
    tuning: Tuning, start: Memory, memory: Memory, samples: Any, dt: float, period: float, number: int, records: Any
) -> Memory:
    """Contact step, passivity and guard of all fingers; fills the contact part of their records.

    samples  a sample (position, quaternion, ...) for each finger, of its handle; so is the wrench that the memory is
             left with, and the record has the fingertip's
    dt       s  time since the last tick
    period   s  nominal length of a tick
    records  a record for each finger

    A sample without a usable pose ends that finger's contact: force zero, everything of it as at the `start`, the ramp
    anew. The world and the other fingers go on.
    """
    fingers, poses = unzip(map_each(arrive, (memory.fingers, tuning.tools, samples), memory.world))
    state, contacts = step(tuning.scene, State(memory.world, fingers), poses, dt)
    hands = map_each(
        command,
        (memory.fingers, start.fingers, samples, state.fingers, contacts, tuning.guards, tuning.tools, records),
        Output(tuning.passivity, tuning.scene.bodies),
        Instant(number, dt, period),
    )
    return Memory(state.world, hands)
