"""The servo's tick and a simulated device in one compiled loop, without a clock: as fast as it goes.

`run_closed_loop` leaves a record of every tick, the bits that the daemon computes with the same device.
`close_loop` keeps figures only and is for kernels of a study, which call it for case after case;
`close_many` does that for rows of parameters.
"""

from __future__ import annotations

import operator
from math import sqrt
from typing import Any, Final, NamedTuple

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray

from softfinger.drivers.plant import (
    LINE_SIZE,
    Intention,
    Plant,
    PlantState,
    advance,
    goal_at,
    sense,
)
from softfinger.drivers.simulation import Simulation
from softfinger.proxy.kernels import vec3
from softfinger.proxy.kernels.jit import OPTIONS, entry, jit
from softfinger.proxy.kernels.pack import flatten, pack, unpack
from softfinger.proxy.state import RECORD_SIZE
from softfinger.server.clock import NS_PER_S, period_ns
from softfinger.server.progress import CHUNK, progress
from softfinger.server.tick import Memory, Tuning, begin, tick

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
    intention: Intention,
    poses: Any,
    line: Any,
    first: int,
    ticks: int,
    dt: float,
    bound: float,
) -> Outcome:
    """Run up to `ticks` ticks from tick `first`; ends early when the handle leaves `bound` (m).

    start      begin(tuning.scene)
    memory     what the last tick left; `start` before the first
    state      of the plant at tick `first`; at_rest(...) before the first
    intention, poses   what the hand wants, see `goal_at`
    line       (LINE_SIZE,) forces under way, changed; zeros before the first
    dt         s  nominal tick, the plant's period
    """
    origin, contact = state.position, memory
    far, strongest, energy, left, done = 0.0, 0.0, 0.0, -1.0, 0
    for number in range(first, first + ticks):
        x, q = sense(plant, state), state.orientation
        sample: Any = (x[0], x[1], x[2], q[0], q[1], q[2], q[3])
        contact = tick(tuning, start, contact, sample, dt, number, NOWHERE)
        force = contact.guarded.force
        goal, orientation = goal_at(intention, poses, number + 1)
        before = state.position
        state = advance(plant, state, force, goal, orientation, line)
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


@entry
def record_ticks(
    tuning_like: Tuning,
    values: Array,
    start: Memory,
    memory_values: Array,
    plant: Plant,
    state_like: PlantState,
    state_values: Array,
    intention: Intention,
    poses: Array,
    line: Array,
    dt: float,
    first: int,
    records: Array,
) -> None:
    """As many ticks as `records` (n, RECORD_SIZE) has rows, from tick `first`; memory and state are carried on."""
    tuning = unpack(tuning_like, values)
    memory = unpack(start, memory_values)
    state = unpack(state_like, state_values)
    for i in range(records.shape[0]):
        x, q = sense(plant, state), state.orientation
        sample: Any = (x[0], x[1], x[2], q[0], q[1], q[2], q[3])
        memory = tick(tuning, start, memory, sample, dt, first + i, records[i])
        records[i, 0] = (first + i) * dt
        goal, orientation = goal_at(intention, poses, first + i + 1)
        state = advance(plant, state, memory.guarded.force, goal, orientation, line)
    pack(memory_values, memory)
    pack(state_values, state)


def run_closed_loop(tuning: Tuning, device: Simulation, rate_hz: float, ticks: int) -> Array:
    """Records (ticks, RECORD_SIZE) of a scene felt through a simulated device, as the daemon computes them.

    The timestamp is the tick times dt, and the fields of servo timing and device are 0.
    """
    dt = period_ns(rate_hz) / NS_PER_S
    records = np.zeros((ticks, RECORD_SIZE))
    start = begin(tuning.scene)
    values, memory, state, line = flatten(tuning), flatten(start), flatten(device.state), np.zeros(LINE_SIZE)
    with progress("simulating", ticks) as done:
        for first in range(0, ticks, CHUNK):
            record_ticks(
                tuning, values, start, memory, device.plant, device.state, state, device.intention, device.poses,
                line, dt, first, records[first : first + CHUNK],
            )  # fmt: skip
            done(min(first + CHUNK, ticks))
    return records


@entry
def close_many(
    tuning_like: Tuning,
    tunings: Array,
    start: Memory,
    plant_like: Plant,
    plants: Array,
    states: Array,
    state_like: PlantState,
    intention: Intention,
    poses: Array,
    line: Array,
    ticks: int,
    bound: float,
    figures: Array,
) -> None:
    """`close_loop` for n cases, each from its beginning.

    tunings, plants, states  (n, ...)  leaves of Tuning, Plant and PlantState of each case, as `flatten` gives them;
                                       one row (1, ...) is for all cases
    figures                  (n, 5)    what is left of each: FIGURES
    """
    for i in range(figures.shape[0]):
        tuning = unpack(tuning_like, tunings[min(i, tunings.shape[0] - 1)])
        plant = unpack(plant_like, plants[min(i, plants.shape[0] - 1)])
        state = unpack(state_like, states[min(i, states.shape[0] - 1)])
        line[:] = 0.0
        dt = 1.0 / plant.rate
        end = close_loop(tuning, start, start, plant, state, intention, poses, line, 0, ticks, dt, bound)
        figures[i, 0] = end.ticks
        figures[i, 1] = end.left
        figures[i, 2] = end.excursion
        figures[i, 3] = end.force
        figures[i, 4] = end.energy
