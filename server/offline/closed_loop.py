"""The servo's tick and simulated devices in one compiled loop, without a clock: as fast as it goes.

`run_closed_loop` leaves a record of every tick, the bits that the daemon computes with the same devices.
`close_loop` keeps figures only and is for kernels of a study, which call it for case after case;
`close_many` does that for rows of parameters.
"""

from __future__ import annotations

import operator
from collections.abc import Iterator, Sequence
from math import sqrt
from typing import Any, Final, NamedTuple

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray

from softfinger.drivers.simulated.options import Simulation
from softfinger.drivers.simulated.plant import LINE_SIZE, Drive, Plant, PlantState, advance, goal_at, sense
from softfinger.proxy.bodies import begin_bodies, check_bodies
from softfinger.proxy.kernels.jit.decorators import OPTIONS, entry, jit
from softfinger.proxy.kernels.jit.pack import Packed, pack, packed, unpack
from softfinger.proxy.kernels.jit.tuples import map_each, rows_of
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.query.bodies import step_bodies
from softfinger.proxy.record import RECORD_SIZE
from softfinger.server.loop.clock import NS_PER_S, period_ns
from softfinger.server.loop.tick import FingerMemory, Memory, Tuning, begin, tick
from softfinger.server.progress import CHUNK, progress

Array = NDArray[np.float64]

FIGURES: Final = ("ticks", "left", "excursion", "force", "energy")
"""What `close_many` leaves of a case: fields of `Outcome`."""


class Nowhere(NamedTuple):
    """A record that keeps nothing: writing to it compiles to nothing."""

    unused: float


NOWHERE: Final[Any] = Nowhere(0.0)


@overload(operator.setitem, jit_options=OPTIONS)
def _set_nowhere(record, index, value):  # type: ignore[no-untyped-def]
    if getattr(record, "instance_class", None) is Nowhere:
        return lambda record, index, value: None
    return None


class Run(NamedTuple):
    """Number of the first tick, how many ticks, and the nominal length of each, s, the plant's period."""

    first: int
    ticks: int
    dt: float


class Outcome(NamedTuple):
    """What a closed loop comes to.

    memory, state  for going on
    ticks          done
    left           tick at which the handle was farther than the bound from where it began, or nowhere; -1 if never
    excursion      m  largest distance of the handle from where it began, at ticks
    force          N  largest norm of the commanded force
    energy         J  work of the commanded force on the handle: force times the way of its tick, summed up;
                      above 0 the scene has given energy, more than its springs held at the start makes it active
    """

    memory: Memory
    state: PlantState
    ticks: float
    left: float
    excursion: float
    force: float
    energy: float


@jit
def close_loop(
    tuning: Tuning,
    start: Memory,
    memory: Memory,
    plant: Plant,
    state: PlantState,
    drive: Drive,
    run: Run,
    bound: float,
) -> Outcome:
    """As many ticks as `run` says; ends early when the handle leaves `bound` (m).

    start   begin(tuning.scene)
    memory  what the last tick left; `start` before the first
    state   of the plant at the first of them; at_rest(...) before the first of all
    """
    dt = run.dt
    origin, contact = state.position, memory
    far, strongest, energy, left, done = 0.0, 0.0, 0.0, -1.0, 0
    for number in range(run.first, run.first + run.ticks):
        x, q = sense(plant, state), state.orientation
        sample: Any = (x[0], x[1], x[2], q[0], q[1], q[2], q[3])
        contact = tick(tuning, start, contact, (sample,), dt, dt, number, (NOWHERE,))
        step_bodies(tuning.scene.bodies)
        force = contact.fingers[0].guarded.force
        goal, orientation = goal_at(drive.intention, drive.poses, number + 1)
        before = state.position
        state = advance(plant, state, force, goal, orientation, drive.line)
        done += 1
        strongest = max(strongest, vec3.dot(force, force))
        energy += vec3.dot(force, vec3.sub(state.position, before))
        away = vec3.sub(state.position, origin)
        distance = vec3.dot(away, away)
        # not (a <= b): a position that is not a number has left as well
        if not distance <= far:
            far = distance
            if not distance <= bound * bound:
                left = number + 1.0
                break
    return Outcome(contact, state, float(done), left, sqrt(far), sqrt(strongest), energy)


class Held(NamedTuple):
    """A simulated device in a hand: what does not change of it, and what drives it."""

    plant: Plant
    drive: Drive


@jit
def sample_of(hand: Held, state: Any) -> Any:
    """What a device says of itself: its pose in a tuple of seven."""
    x, q = sense(hand.plant, state), state.orientation
    return x[0], x[1], x[2], q[0], q[1], q[2], q[3]


@jit
def advance_device(hand: Held, state: Any, finger: FingerMemory, number: int) -> Any:
    """State of a device at tick `number`, after what its FingerMemory commands of it."""
    plant, drive = hand.plant, hand.drive
    goal, orientation = goal_at(drive.intention, drive.poses, number)
    return advance(plant, state, finger.guarded.force, goal, orientation, drive.line)


@entry
def record_ticks(
    tuning_packed: Packed,
    memory_packed: Packed,
    hands: Any,
    states_packed: Packed,
    dt: float,
    first: int,
    records: Array,
) -> None:
    """As many ticks of `dt` s as `records` (n, fingers, RECORD_SIZE) has rows, from tick `first`.

    tuning_packed  Tuning
    memory_packed  Memory, as it is before the first tick of all; its leaves are those of now, and carried on
    hands          a Held for each finger, in a tuple
    states_packed  a PlantState of each in a tuple, carried on as the memory
    """
    start = memory_packed.like
    tuning = unpack(tuning_packed.like, tuning_packed.values)
    memory = unpack(start, memory_packed.values)
    states = unpack(states_packed.like, states_packed.values)
    for i in range(records.shape[0]):
        rows = rows_of(memory.fingers, records[i], 0)
        memory = tick(tuning, start, memory, map_each(sample_of, (hands, states)), dt, dt, first + i, rows)
        step_bodies(tuning.scene.bodies)
        records[i, :, 0] = (first + i) * dt
        states = map_each(advance_device, (hands, states, memory.fingers), first + i + 1)
    pack(memory_packed.values, memory)
    pack(states_packed.values, states)


def run_closed_loop(tuning: Tuning, devices: Sequence[Simulation], rate_hz: float, ticks: int) -> Iterator[Array]:
    """Simulate a scene felt through a device for each finger, as the daemon computes it, and yield the records.

    Blocks (m, fingers, RECORD_SIZE) of at most CHUNK ticks. The timestamp is the tick times dt, and the fields of servo
    timing and device are 0.
    """
    dt = period_ns(rate_hz) / NS_PER_S
    begin_bodies(tuning.scene, dt)
    scene_and_guard, memory = packed(tuning), packed(begin(tuning.scene))
    states = packed(tuple(device.state for device in devices))
    hands = tuple(Held(each.plant, Drive(each.intention, each.poses, np.zeros(LINE_SIZE))) for each in devices)
    with progress("simulating", ticks) as done:
        for first in range(0, ticks, CHUNK):
            records = np.zeros((min(CHUNK, ticks - first), len(devices), RECORD_SIZE))
            record_ticks(scene_and_guard, memory, hands, states, dt, first, records)
            check_bodies(tuning.scene)
            yield records
            done(first + len(records))


@entry
def close_many(
    tunings: Packed,
    start: Memory,
    plants: Packed,
    states: Packed,
    drive: Drive,
    ticks: int,
    bound: float,
    figures: Array,
) -> None:
    """`close_loop` for n cases, each from its beginning.

    tunings, plants, states  Tuning, Plant and PlantState of each case, leaves (n, ...); one row (1, ...) is for all
    figures                  (n, 5) what is left of each: FIGURES
    """
    for i in range(figures.shape[0]):
        tuning = unpack(tunings.like, tunings.values[min(i, tunings.values.shape[0] - 1)])
        plant = unpack(plants.like, plants.values[min(i, plants.values.shape[0] - 1)])
        state = unpack(states.like, states.values[min(i, states.values.shape[0] - 1)])
        drive.line[:] = 0.0
        end = close_loop(tuning, start, start, plant, state, drive, Run(0, ticks, 1.0 / plant.rate), bound)
        figures[i, 0] = end.ticks
        figures[i, 1] = end.left
        figures[i, 2] = end.excursion
        figures[i, 3] = end.force
        figures[i, 4] = end.energy
