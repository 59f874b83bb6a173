"""A device that is computed: handle, motors and hand of `drivers.plant`, behind the contract of any other.

A replay feels nothing. Here the force written moves the handle, and the hand on it follows what it intends, a
recording or a place with a sinusoid about it, as far as the force lets it. Read number n gives the pose at tick n of
the device's own time, so a run is reproducible to the bit whatever the clock does.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numba import carray

from softfinger.config.devices import presets
from softfinger.drivers import wrench_log
from softfinger.drivers.base import END, OK, Device, DeviceInfo, DeviceIO
from softfinger.drivers.plant import LINE_SIZE, Intention, advance, at_rest, goal_at, make_plant, sense
from softfinger.drivers.simulation import Options, simulation
from softfinger.drivers.wrench_log import IO_SIGNATURE, READS, ROW_BYTES, WrenchLog, Written
from softfinger.proxy.kernels.jit import c_function
from softfinger.proxy.kernels.memory import float64_at, int64_at
from softfinger.proxy.kernels.pack import flatten, pack, unpack

# Words of the block behind the handle, after those of the log: addresses of float64 arrays.
PLANT: Final = wrench_log.WORDS
STATE: Final = PLANT + 1
INTENTION: Final = PLANT + 2
POSES: Final = PLANT + 3
LINE: Final = PLANT + 4
WORDS: Final = PLANT + 5

# No motor turns the handle, but the torque is taken: it belongs to the contact and to telemetry.
TORQUE_MAX_NM: Final = 1e2

_PLANT_LIKE: Final = make_plant(1.0, (1.0, 1.0, 1.0))
_STATE_LIKE: Final = at_rest((0.0, 0.0, 0.0))
_INTENTION_LIKE: Final = Intention(1.0, 0.0, (0.0, 0.0, 0.0), 0.0, 0.0)
_PLANT_SIZE: Final = len(flatten(_PLANT_LIKE))
_STATE_SIZE: Final = len(flatten(_STATE_LIKE))
_INTENTION_SIZE: Final = len(flatten(_INTENTION_LIKE))


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
            # The newest wrench acts until now. A stop that writes its zero just now may be read in part: every
            # component is the old one or zero, and the next read has the zero.
            force = (0.0, 0.0, 0.0)
            if word[wrench_log.WRITES] > 0:
                last = word[wrench_log.NEXT_ROW] - 1
                if last < 0:
                    last += word[wrench_log.CAPACITY]
                row = float64_at(word[wrench_log.LOG] + last * ROW_BYTES)
                force = (row[1], row[2], row[3])
            goal, orientation = goal_at(intention, float64_at(word[POSES]), n)
            state = advance(plant, state, force, goal, orientation, float64_at(word[LINE]))
            pack(kept, state)
    word[READS] += 1
    position = sense(plant, state)
    for k in range(3):
        sample[k] = position[k]
    for k in range(4):
        sample[3 + k] = state.orientation[k]
    sample[7] = n / plant.rate
    sample[8] = 0.0
    return status


class Simulated(Device):
    """The plant as a device; what is written to it acts on the handle, and is kept as a replay keeps it.

    Once stopped it stays disarmed: no force acts any more but those under way, and the hand goes on.
    """

    def __init__(self, options: Options, rate_hz: float) -> None:
        preset = presets()[options.preset]
        self.simulation = simulation(options, rate_hz)
        plant, state, intention, poses = self.simulation
        self._arrays = (flatten(plant), flatten(state), flatten(intention), poses, np.zeros(LINE_SIZE))
        self._word = np.zeros(WORDS, dtype=np.int64)
        self._log = WrenchLog(self._word, int(intention.length), rate_hz, options.forces)
        self._word[PLANT:WORDS] = [array.ctypes.data for array in self._arrays]
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
        return DeviceIO(_read.address, wrench_log.write.address, self._word.ctypes.data)

    def stop(self) -> None:
        self._log.stop()

    def close(self) -> None:
        self._log.close()

    def written(self) -> Written:
        """The wrenches kept, oldest first. While the servo runs: those that were complete just now."""
        return self._log.written()


def open_device(options: Options, rate_hz: float) -> Simulated:
    """Open a simulated device at `rate_hz`; RecordingError when its recording cannot be used."""
    return Simulated(options, rate_hz)
