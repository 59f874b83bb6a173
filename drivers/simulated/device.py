"""Simulated device: handle, motors and hand of `plant`, behind the device contract.

Unlike in a replay, the written force moves the handle. The hand follows its intention (a recording, or a fixed position
with a sinusoid) against the force. Read number n returns the pose at tick n of the device's time, so that a run is
reproducible to the bit regardless of the clock, unless a puck or a program leads the hand.
"""

from __future__ import annotations

import dataclasses
import os
from functools import partial
from typing import Annotated, Any, Final, NamedTuple

from msgspec.structs import replace

from softfinger.drivers import wrench_log
from softfinger.drivers.base import END, OK, SAMPLE_BUTTONS, SAMPLE_GRIPPER, SAMPLE_TIME, make_info
from softfinger.drivers.block import Block, address, lay_out, numbers, word
from softfinger.drivers.closeable import undo_on_error
from softfinger.drivers.samples import store_pose
from softfinger.drivers.simulated import hand as led_hand
from softfinger.drivers.simulated.options import Options, load_presets, make_simulation
from softfinger.drivers.simulated.plant import (
    DELAY_LINE_SIZE,
    Handle,
    Intention,
    Plant,
    PlantState,
    advance,
    compute_goal,
    make_plant,
    make_rest_state,
    sense,
)
from softfinger.drivers.spacemouse import device as spacemouse
from softfinger.drivers.spacemouse.device import Puck, compute_pose, read_buttons, read_setup, update_pose
from softfinger.drivers.system.libc import IO_SIGNATURE, read_monotonic_ns
from softfinger.drivers.wrench_log import LOG, ROW_BYTES, LoggedDevice
from softfinger.proxy.kernels.jit.decorators import c_function, jit
from softfinger.proxy.kernels.jit.memory import float64_array_at, float64_at, int64_at
from softfinger.proxy.kernels.jit.pack import flatten, pack, unflatten, unpack, unpack_at
from softfinger.proxy.kernels.model import Vec3

_PLANT_LIKE: Final = make_plant(1.0, Handle((1.0, 1.0, 1.0)))
_STATE_LIKE: Final = make_rest_state((0.0, 0.0, 0.0))
_INTENTION_LIKE: Final = Intention(1.0, 0.0, (0.0, 0.0, 0.0), 0.0, 0.0)
_PLANT_SIZE: Final = len(flatten(_PLANT_LIKE))
_STATE_SIZE: Final = len(flatten(_STATE_LIKE))
_INTENTION_SIZE: Final = len(flatten(_INTENTION_LIKE))


class Fields(NamedTuple):
    """Fields of a simulated device, after the fields of the log."""

    plant: Annotated[int, numbers("a `Plant`", _PLANT_SIZE)]
    state: Annotated[int, numbers("a `PlantState`", _STATE_SIZE)]
    intention: Annotated[int, numbers("an `Intention`", _INTENTION_SIZE)]
    delay_line: Annotated[int, numbers("queued forces", DELAY_LINE_SIZE)]
    poses: Annotated[int, address("(n, 7) float64 of the recording")]
    puck: Annotated[int, word("handle of the SpaceMouse that moves the hand, 0 without one")]
    hand: Annotated[int, word("handle of the hand that a program may move")]


AT: Final = lay_out(Fields, after=LOG)


@jit
def _read_force(handle: int) -> Vec3:
    """Return the force (3,) N of the latest wrench, which acts until now.

    If `stop` is writing its zero at this moment, each component is the old one or zero; the next read gets the zero.
    """
    word = int64_at(handle)
    if word[LOG.writes] == 0:
        return (0.0, 0.0, 0.0)
    last = word[LOG.next_row] - 1
    if last < 0:
        last += word[LOG.capacity]
    row = float64_at(word[LOG.log] + last * ROW_BYTES)
    return (row[1], row[2], row[3])


@jit
def _fill_sample(sample: Any, plant: Plant, state: PlantState, n: int, buttons: float) -> None:
    store_pose(sample, sense(plant, state), state.orientation)
    sample[SAMPLE_TIME] = n / plant.rate
    sample[SAMPLE_BUTTONS] = buttons
    sample[SAMPLE_GRIPPER] = 0.0


@c_function(IO_SIGNATURE)
def _read(handle: int, sample: Any) -> int:
    word = int64_at(handle)
    plant = unpack_at(_PLANT_LIKE, handle + 8 * AT.plant)
    intention = unpack_at(_INTENTION_LIKE, handle + 8 * AT.intention)
    stored_state = float64_array_at(handle + 8 * AT.state, _STATE_SIZE)
    state = unpack(_STATE_LIKE, stored_state)
    n, status = word[LOG.reads], OK
    if n > 0:
        if intention.loop == 0.0 and n >= intention.length:
            n, status = int(intention.length) - 1, END
        else:
            own, own_turn = compute_goal(intention, float64_at(word[AT.poses]), n)
            hand = word[AT.hand]
            led_hand.receive(hand)
            goal, orientation = led_hand.compute_intention(hand, own, own_turn, state.goal, 1.0 / plant.rate)
            state = advance(
                plant, state, _read_force(handle), goal, orientation, float64_at(handle + 8 * AT.delay_line)
            )
            pack(stored_state, state)
    word[LOG.reads] += 1
    _fill_sample(sample, plant, state, n, 0.0)
    return status


@c_function(IO_SIGNATURE, on_demand=True)
def _read_led_by_puck(handle: int, sample: Any) -> int:
    """Implement `read` for a hand that a puck leads; like the plant, it moves by one period per read."""
    word = int64_at(handle)
    plant = unpack_at(_PLANT_LIKE, handle + 8 * AT.plant)
    stored_state = float64_array_at(handle + 8 * AT.state, _STATE_SIZE)
    state = unpack(_STATE_LIKE, stored_state)
    puck, n = word[AT.puck], word[LOG.reads]
    if n > 0:
        status = update_pose(
            puck, read_setup(puck), read_monotonic_ns(puck + 8 * spacemouse.AT.timespec), 1.0 / plant.rate
        )
        if status < 0:
            return status
        goal, orientation = compute_pose(puck)
        state = advance(plant, state, _read_force(handle), goal, orientation, float64_at(handle + 8 * AT.delay_line))
        pack(stored_state, state)
    word[LOG.reads] += 1
    _fill_sample(sample, plant, state, n, read_buttons(puck))
    return OK


class SimulatedDevice(LoggedDevice):
    """Plant as a device; written wrenches act on the handle, and are logged.

    After `stop` it remains disarmed: only delayed forces still act, and the hand continues to move.
    """

    def __init__(self, options: Options, rate_hz: float, puck: tuple[int, str] | None = None) -> None:
        """Create the device; `puck`: file descriptor and name of an open puck, which the device then owns."""
        preset = load_presets()[options.preset]
        self.simulation = make_simulation(options, rate_hz)
        plant, state, intention, poses = self.simulation
        block = Block(LOG, AT)
        super().__init__(block, int(intention.length), rate_hz, options.forces)
        block.numbers(AT.plant, _PLANT_SIZE)[:] = flatten(plant)
        stored_state = block.numbers(AT.state, _STATE_SIZE)
        stored_state[:] = flatten(state)
        block.numbers(AT.intention, _INTENTION_SIZE)[:] = flatten(intention)
        block.set_address(AT.poses, poses)
        self._hand = led_hand.HandWriter(state.orientation, lambda: unflatten(_STATE_LIKE, stored_state).goal)
        block.word[AT.hand] = self._hand.handle
        self._puck: Puck | None = None
        self._puck_name = ""
        if options.puck is not None and puck is not None:
            fd, self._puck_name = puck
            self._puck_block = Block(LOG, spacemouse.AT)
            # a device that senses no orientation ignores rotations of the puck
            turning = options.puck if preset.sensed_dof == 6 else replace(options.puck, gain_rad_per_s=0.0)
            self._puck = Puck(turning, fd, self._puck_block)
            block.word[AT.puck] = self._puck_block.handle
        self._functions = _read if self._puck is None else _read_led_by_puck, wrench_log.write
        info = make_info(preset, f"simulated {preset.name}", preset.sensed_dof)
        self.info = dataclasses.replace(info, force_max_n=plant.force_max, own_clock=True)

    def close(self) -> None:
        try:
            super().close()
        finally:
            if self._puck is not None:
                self._puck.close()

    def reason(self) -> str:
        return f"its hand is moved by {self._puck_name}" if self._puck_name else ""

    def hand(self) -> led_hand.HandWriter | None:
        return self._hand if self._puck is None else None

    def counts(self) -> dict[str, int]:
        return super().counts() | (self._puck_block.counts(spacemouse.AT) if self._puck is not None else {})


def open_device(options: Options, rate_hz: float) -> SimulatedDevice:
    """Open a simulated device at `rate_hz`.

    Raises RecordingError if its recording cannot be used, DeviceError or a subclass if its puck cannot.
    """
    if options.puck is None:
        return SimulatedDevice(options, rate_hz)
    fd, name = spacemouse.open_puck(options.puck)
    with undo_on_error(partial(os.close, fd)):
        return SimulatedDevice(options, rate_hz, (fd, name))
