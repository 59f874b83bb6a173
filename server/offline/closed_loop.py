"""The servo's tick and simulated devices in one compiled loop without a clock, as fast as possible.

`run_closed_loop` yields a record of every tick, equal bit for bit to the daemon's with the same devices. `close_loop`
returns only figures; kernels of a study call it for each case. `close_many` calls it for rows of parameters.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator, Mapping, Sequence
from math import sqrt
from typing import Any, Final, NamedTuple

import numba
import numpy as np
from numba import types
from numba.extending import overload

from softfinger.config.arrays import Array
from softfinger.drivers.simulated.options import Simulation
from softfinger.drivers.simulated.plant import (
    DELAY_LINE_SIZE,
    Plant,
    PlantInputs,
    PlantState,
    advance,
    compute_goal,
    sense,
)
from softfinger.proxy.bodies import begin_bodies, check_bodies
from softfinger.proxy.kernels.jit.decorators import OPTIONS, PLAIN, entry, jit
from softfinger.proxy.kernels.jit.pack import PackedTree, flatten, pack, unpack
from softfinger.proxy.kernels.jit.tuples import map_each, rows_of
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.query.bodies import step_bodies
from softfinger.proxy.record import RECORD_SIZE
from softfinger.server.loop.clock import NS_PER_S, compute_period_ns
from softfinger.server.loop.tick import FingerMemory, Memory, Tuning, make_start_memory, run_tick
from softfinger.server.offline.scene_messages import NO_MESSAGES, SceneMessages
from softfinger.server.progress import CHUNK, show_progress

FIGURES: Final = ("ticks", "exit_tick", "excursion", "force", "energy")
"""Figures of a case that `close_many` writes: fields of `ClosedLoopResult`."""


class NullRecord(NamedTuple):
    """Record that discards all values: writes to it compile to nothing."""

    unused: float


NULL_RECORD: Final[Any] = NullRecord(0.0)


@overload(operator.setitem, jit_options=OPTIONS)
def _set_null_record(record, index, value):  # type: ignore[no-untyped-def]
    if getattr(record, "instance_class", None) is NullRecord:
        return lambda record, index, value: None
    return None


class TickRange(NamedTuple):
    """Number of the first tick, number of ticks, and nominal period of a tick, s, which is the plant's period."""

    first: int
    ticks: int
    dt: float


class ClosedLoopResult(NamedTuple):
    """Result of a closed loop.

    memory, state  for the continuation
    ticks          number of ticks run
    exit_tick      tick at which the handle left the bound around its start, or became nan; -1 if never
    excursion      m  largest distance of the handle from its start, at ticks
    force          N  largest norm of the commanded force
    energy         J  work of the commanded force on the handle: sum over ticks of force times displacement;
                      above 0 the scene has released energy, above the initial energy of its springs it is active
    """

    memory: Memory
    state: PlantState
    ticks: float
    exit_tick: float
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
    drive: PlantInputs,
    run: TickRange,
    bound: float,
) -> ClosedLoopResult:
    """Run the ticks of `run`; stop early when the handle leaves `bound` (m).

    start   make_start_memory(tuning.scene)
    memory  after the previous tick; `start` before the first
    state   of the plant at the first tick of `run`; at_rest(...) at the start
    """
    dt = run.dt
    origin, contact = state.position, memory
    max_distance2, max_force2, energy, exit_tick, tick_count = 0.0, 0.0, 0.0, -1.0, 0
    for tick_number in range(run.first, run.first + run.ticks):
        x, q = sense(plant, state), state.orientation
        sample: Any = (x[0], x[1], x[2], q[0], q[1], q[2], q[3])
        contact = run_tick(tuning, start, contact, (sample,), dt, dt, tick_number, (NULL_RECORD,))
        step_bodies(tuning.scene.bodies)
        force = contact.fingers[0].guard_state.force
        goal, orientation = compute_goal(drive.intention, drive.poses, tick_number + 1)
        previous_position = state.position
        state = advance(plant, state, force, goal, orientation, drive.line)
        tick_count += 1
        max_force2 = max(max_force2, vec3.dot(force, force))
        energy += vec3.dot(force, vec3.sub(state.position, previous_position))
        displacement = vec3.sub(state.position, origin)
        distance2 = vec3.dot(displacement, displacement)
        # not (a <= b): also true for a position of nan
        if not distance2 <= max_distance2:
            max_distance2 = distance2
            if not distance2 <= bound * bound:
                exit_tick = tick_number + 1.0
                break
    return ClosedLoopResult(contact, state, float(tick_count), exit_tick, sqrt(max_distance2), sqrt(max_force2), energy)


class DrivenPlant(NamedTuple):
    """Simulated device in a hand: its constants and its drive."""

    plant: Plant
    drive: PlantInputs


@jit
def sense_device(hand: DrivenPlant, state: Any) -> Any:
    """Return the sensed pose of a device as a tuple of seven."""
    x, q = sense(hand.plant, state), state.orientation
    return x[0], x[1], x[2], q[0], q[1], q[2], q[3]


@jit
def advance_device(hand: DrivenPlant, state: Any, finger: FingerMemory, tick_number: int) -> Any:
    """Return the state of a device at a tick under the wrench of its FingerMemory."""
    plant, drive = hand.plant, hand.drive
    goal, orientation = compute_goal(drive.intention, drive.poses, tick_number)
    return advance(plant, state, finger.guard_state.force, goal, orientation, drive.line)


@entry
def record_ticks(
    parameters: Any,
    parameter_values: Array,
    state: Any,
    state_values: Array,
    hands: Any,
    dt: float,
    first: int,
    records: Array,
) -> None:
    """Run a tick of `dt` s for each row of `records` (n, fingers, RECORD_SIZE), from tick `first`.

    parameters  type of (Tuning, initial Memory), with the leaves `parameter_values`
    state       type of (Memory, tuple of a PlantState for each finger); the leaves `state_values` are updated
    hands       tuple of a DrivenPlant for each finger
    """
    tuning, start = unpack(parameters, parameter_values)
    memory, states = unpack(state, state_values)
    for i in range(records.shape[0]):
        rows = rows_of(memory.fingers, records[i], 0)
        memory = run_tick(tuning, start, memory, map_each(sense_device, (hands, states)), dt, dt, first + i, rows)
        step_bodies(tuning.scene.bodies)
        records[i, :, 0] = (first + i) * dt
        states = map_each(advance_device, (hands, states, memory.fingers), first + i + 1)
    pack(state_values, (memory, states))


class ClosedLoop:
    """Scene and guard with a simulated device for each finger, at the start of a run.

    numba's dispatcher would determine the types of all parameters on each call, in a hundred microseconds: the kernel
    is compiled for them on the first.
    """

    def __init__(self, tuning: Tuning, states: Sequence[PlantState]) -> None:
        self.scene: Final = tuning.scene
        start = make_start_memory(tuning.scene)
        self._parameters, self._state = (tuning, start), (start, tuple(states))
        self._state_values = flatten(self._state)
        self._prepare()

    def _prepare(self) -> None:
        self._parameter_values = flatten(self._parameters)
        self._advance: Callable[..., None] | None = None

    def __getstate__(self) -> dict[str, Any]:
        """Return the state from which a copy continues: addresses of arrays and machine code are not part of it."""
        return {name: vars(self)[name] for name in ("scene", "_parameters", "_state", "_state_values")}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        vars(self).update(state)
        self._prepare()

    def reset(self) -> None:
        """Go back to the start; `begin_bodies` does that for the bodies of a [world]."""
        self._state_values[:] = flatten(self._state)

    def run(self, hands: tuple[DrivenPlant, ...], dt: float, first: int, records: Array) -> None:
        """Run a tick for each of `records`, as `record_ticks`. Raises SafetyStop if the bodies of a [world] fail."""
        advance = self._advance or self._compile(hands)
        advance(self._parameters, self._parameter_values, self._state, self._state_values, hands, dt, first, records)
        check_bodies(self.scene)

    def _compile(self, hands: tuple[DrivenPlant, ...]) -> Callable[..., None]:
        kernel: Any = record_ticks
        if not PLAIN:
            parameters, state = (types.TypeRef(numba.typeof(tree)) for tree in (self._parameters, self._state))
            leaves, table = types.float64[::1], types.float64[:, :, ::1]
            arguments = parameters, leaves, state, leaves, numba.typeof(hands), types.float64, types.int64, table
            kernel = kernel.compile(arguments)
        advance: Callable[..., None] = kernel
        self._advance = advance
        return advance


def run_closed_loop(
    tuning: Tuning, devices: Sequence[Simulation], rate_hz: float, ticks: int, messages: SceneMessages = NO_MESSAGES
) -> Iterator[Array]:
    """Simulate a scene with a simulated device for each finger as the daemon does, and yield the records.

    Yields blocks (m, fingers, RECORD_SIZE) of at most CHUNK ticks. The timestamp is the tick times dt; the fields of
    servo timing and device are 0. `messages` receives the messages of the scene's topics.
    """
    dt = compute_period_ns(rate_hz) / NS_PER_S
    begin_bodies(tuning.scene, dt)
    loop = ClosedLoop(tuning, [device.state for device in devices])
    hands = tuple(
        DrivenPlant(simulation.plant, PlantInputs(simulation.intention, simulation.poses, np.zeros(DELAY_LINE_SIZE)))
        for simulation in devices
    )
    with show_progress("simulating", ticks) as advance:
        for first in range(0, ticks, CHUNK):
            records = np.zeros((min(CHUNK, ticks - first), len(devices), RECORD_SIZE))
            for first_tick, part in messages.split(tuning.scene, first, records):
                loop.run(hands, dt, first_tick, records[part])
            yield records
            advance(first + len(records))


@entry
def close_many(
    tunings: PackedTree,
    start: Memory,
    plants: PackedTree,
    states: PackedTree,
    drive: PlantInputs,
    ticks: int,
    bound: float,
    figures: Array,
) -> None:
    """Run `close_loop` for n cases, each from its start.

    tunings, plants, states  Tuning, Plant and PlantState of each case, leaves (n, ...); one row (1, ...) applies to all
    figures                  (n, 5) FIGURES of each case, written
    """
    for i in range(figures.shape[0]):
        tuning = unpack(tunings.like, tunings.values[min(i, tunings.values.shape[0] - 1)])
        plant = unpack(plants.like, plants.values[min(i, plants.values.shape[0] - 1)])
        state = unpack(states.like, states.values[min(i, states.values.shape[0] - 1)])
        drive.line[:] = 0.0
        end = close_loop(tuning, start, start, plant, state, drive, TickRange(0, ticks, 1.0 / plant.rate), bound)
        figures[i, 0] = end.ticks
        figures[i, 1] = end.exit_tick
        figures[i, 2] = end.excursion
        figures[i, 3] = end.force
        figures[i, 4] = end.energy
