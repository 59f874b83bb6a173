"""A device that is computed: handle, motors and hand of `drivers.plant`, behind the contract of any other.

A replay feels nothing. Here the force written moves the handle, and the hand on it follows what it intends, a
recording or a place with a sinusoid about it, as far as the force lets it. Read number n gives the pose at tick n of
the device's own time, so a run is reproducible to the bit whatever the clock does. Only a hand
that a puck leads does what it likes.
"""

from __future__ import annotations

import os
from typing import Any, Final

import numpy as np
from msgspec.structs import replace
from numba import carray

from softfinger.config.devices import presets
from softfinger.drivers import spacemouse, wrench_log
from softfinger.drivers.base import (
    END,
    OK,
    SAMPLE_BUTTONS,
    SAMPLE_GRIPPER,
    SAMPLE_TIME,
    Device,
    DeviceInfo,
    DeviceIO,
)
from softfinger.drivers.libc import IO_SIGNATURE, monotonic_ns
from softfinger.drivers.plant import (
    LINE_SIZE,
    Intention,
    Plant,
    PlantState,
    advance,
    at_rest,
    goal_at,
    make_plant,
    sense,
)
from softfinger.drivers.simulation import Options, simulation
from softfinger.drivers.spacemouse import SETUP, SETUP_LIKE, SETUP_SIZE, Puck, follow, mask, place
from softfinger.drivers.wrench_log import READS, ROW_BYTES, WrenchLog, Written
from softfinger.proxy.kernels.jit import c_function, jit
from softfinger.proxy.kernels.memory import float64_at, int64_at
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.pack import flatten, pack, unpack

# Words of the block behind the handle, after those of the log: addresses of float64 arrays.
PLANT: Final = wrench_log.WORDS
STATE: Final = PLANT + 1
INTENTION: Final = PLANT + 2
POSES: Final = PLANT + 3
LINE: Final = PLANT + 4
PUCK: Final = PLANT + 5  # handle of the puck that leads the hand, 0 without one
WORDS: Final = PLANT + 6

# No motor turns the handle, but the torque is taken: it belongs to the contact and to telemetry.
TORQUE_MAX_NM: Final = 1e2

_PLANT_LIKE: Final = make_plant(1.0, (1.0, 1.0, 1.0))
_STATE_LIKE: Final = at_rest((0.0, 0.0, 0.0))
_INTENTION_LIKE: Final = Intention(1.0, 0.0, (0.0, 0.0, 0.0), 0.0, 0.0)
_PLANT_SIZE: Final = len(flatten(_PLANT_LIKE))
_STATE_SIZE: Final = len(flatten(_STATE_LIKE))
_INTENTION_SIZE: Final = len(flatten(_INTENTION_LIKE))


@jit
def _acting(handle: int) -> Vec3:
    """Force (3,) N of the newest wrench, which acts until now.

    A stop that writes its zero just now may be read in part: every component is the old one or zero, and the next
    read has the zero.
    """
    word = int64_at(handle)
    if word[wrench_log.WRITES] == 0:
        return (0.0, 0.0, 0.0)
    last = word[wrench_log.NEXT_ROW] - 1
    if last < 0:
        last += word[wrench_log.CAPACITY]
    row = float64_at(word[wrench_log.LOG] + last * ROW_BYTES)
    return (row[1], row[2], row[3])


@jit
def _tell(sample: Any, plant: Plant, state: PlantState, n: int, buttons: float) -> None:
    position = sense(plant, state)
    for k in range(3):
        sample[k] = position[k]
    for k in range(4):
        sample[3 + k] = state.orientation[k]
    sample[SAMPLE_TIME] = n / plant.rate
    sample[SAMPLE_BUTTONS] = buttons
    sample[SAMPLE_GRIPPER] = 0.0


@c_function(IO_SIGNATURE)
def _read(handle: int, sample: Any) -> int:
    word = int64_at(handle)
    plant = unpack(_PLANT_LIKE, carray(float64_at(word[PLANT]), (_PLANT_SIZE,)))
    intention = unpack(_INTENTION_LIKE, carray(float64_at(word[INTENTION]), (_INTENTION_SIZE,)))
    kept = carray(float64_at(word[STATE]), (_STATE_SIZE,))
    state = unpack(_STATE_LIKE, kept)
    n, status = word[READS], OK
    if n > 0:
        if intention.loop == 0.0 and n >= intention.length:
            n, status = int(intention.length) - 1, END
        else:
            goal, orientation = goal_at(intention, float64_at(word[POSES]), n)
            state = advance(plant, state, _acting(handle), goal, orientation, float64_at(word[LINE]))
            pack(kept, state)
    word[READS] += 1
    _tell(sample, plant, state, n, 0.0)
    return status


@c_function(IO_SIGNATURE)
def _read_led(handle: int, sample: Any) -> int:
    """The same with a hand that a puck leads, which moves by one period a read, as the plant does."""
    word = int64_at(handle)
    plant = unpack(_PLANT_LIKE, carray(float64_at(word[PLANT]), (_PLANT_SIZE,)))
    kept = carray(float64_at(word[STATE]), (_STATE_SIZE,))
    state = unpack(_STATE_LIKE, kept)
    puck, n = word[PUCK], word[READS]
    if n > 0:
        setup = unpack(SETUP_LIKE, carray(float64_at(int64_at(puck)[SETUP]), (SETUP_SIZE,)))
        status = follow(puck, setup, monotonic_ns(puck + spacemouse.TIMESPEC * 8), 1.0 / plant.rate)
        if status < 0:
            return status
        goal, orientation = place(puck)
        state = advance(plant, state, _acting(handle), goal, orientation, float64_at(word[LINE]))
        pack(kept, state)
    word[READS] += 1
    _tell(sample, plant, state, n, mask(puck))
    return OK


class Simulated(Device):
    """The plant as a device; what is written to it acts on the handle, and is kept as a replay keeps it.

    Once stopped it stays disarmed: no force acts any more but those under way, and the hand goes on.
    """

    def __init__(self, options: Options, rate_hz: float, puck: tuple[int, str] | None = None) -> None:
        """`puck`: file descriptor and name of an open one, for options that ask for it; it is this device's now."""
        preset = presets()[options.preset]
        self.simulation = simulation(options, rate_hz)
        plant, state, intention, poses = self.simulation
        self._arrays = (flatten(plant), flatten(state), flatten(intention), poses, np.zeros(LINE_SIZE))
        self._word = np.zeros(WORDS, dtype=np.int64)
        self._log = WrenchLog(self._word, int(intention.length), rate_hz, options.forces)
        self._word[PLANT : LINE + 1] = [array.ctypes.data for array in self._arrays]
        self._puck: Puck | None = None
        self._led_by = ""
        if options.puck is not None and puck is not None:
            fd, self._led_by = puck
            self._puck_word = np.zeros(spacemouse.WORDS, dtype=np.int64)
            # What a device does not sense, no puck turns.
            turning = options.puck if preset.sensed_dof == 6 else replace(options.puck, gain_rad_per_s=0.0)
            self._puck = Puck(turning, fd, self._puck_word)
            self._word[PUCK] = self._puck_word.ctypes.data
        reach = preset.workspace_radius_m
        self.info = DeviceInfo(
            name=f"simulated {preset.name}",
            sensed_dof=preset.sensed_dof,
            actuated_dof=3,
            force_max_n=plant.force_max,
            torque_max_nm=TORQUE_MAX_NM,
            stiffness_max_n_per_m=preset.stiffness_max_n_per_m,
            damping_max_ns_per_m=preset.damping_max_ns_per_m,
            workspace_min_m=(-reach, -reach, -reach),
            workspace_max_m=(reach, reach, reach),
            own_clock=True,
        )

    def io(self) -> DeviceIO:
        read = _read if self._puck is None else _read_led
        return DeviceIO(read.address, wrench_log.write.address, self._word.ctypes.data)

    def stop(self) -> None:
        self._log.stop()

    def close(self) -> None:
        try:
            self._log.close()
        finally:
            if self._puck is not None:
                self._puck.close()

    def reason(self) -> str:
        return f"its hand is led by {self._led_by}" if self._led_by else ""

    def counts(self) -> dict[str, int]:
        return self._log.counts() | (self._puck.counts() if self._puck is not None else {})

    def written(self) -> Written:
        """The wrenches kept, oldest first. While the servo runs: those that were complete just now."""
        return self._log.written()


def open_device(options: Options, rate_hz: float) -> Simulated:
    """Open a simulated device at `rate_hz`.

    Raises RecordingError when its recording cannot be used, DeviceError and its kinds when its puck cannot.
    """
    if options.puck is None:
        return Simulated(options, rate_hz)
    fd, name = spacemouse.open_puck(options.puck)
    try:
        return Simulated(options, rate_hz, (fd, name))
    except BaseException:
        os.close(fd)
        raise
