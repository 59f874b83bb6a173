"""A device that is computed: handle, motors and hand of `drivers.plant`, behind the contract of any other.

A replay feels nothing. Here the force written moves the handle, and the hand on it follows what it intends, a
recording or a place with a sinusoid about it, as far as the force lets it. Read number n gives the pose at tick n of
the device's own time, so a run is reproducible to the bit whatever the clock does.
"""

from __future__ import annotations

from typing import Annotated, Any, Final, Literal, NamedTuple

import numpy as np
from msgspec import Meta
from numba import carray

from softfinger.config import limits
from softfinger.config.devices import Preset, presets
from softfinger.config.schema import Coordinate, Table, known, said, within
from softfinger.drivers import wrench_log
from softfinger.drivers.base import END, OK, Device, DeviceInfo, DeviceIO
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
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import Array, close_loop, resample
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

RECORDING: Final = "press-roll-spin-drag"
"""What the hand does when nothing else is said."""
# No motor turns the handle, but the torque is taken: it belongs to the contact and to telemetry.
TORQUE_MAX_NM: Final = 1e2

Mass = Annotated[float, Meta(ge=limits.MASS_KG.low, le=limits.MASS_KG.high)]
Damping = Annotated[float, Meta(ge=limits.DAMPING_NS_PER_M.low, le=limits.DAMPING_NS_PER_M.high)]
Friction = Annotated[float, Meta(ge=limits.DEVICE_FRICTION_N.low, le=limits.DEVICE_FRICTION_N.high)]


class Hand(Table, frozen=True, kw_only=True):
    """The hand that holds the handle: its mass moves with it, spring and damper pull towards what it intends."""

    mass_kg: Annotated[float, within(limits.HAND_MASS_KG, "mass that moves with the handle", 0.1)] = 0.1
    damping_ns_per_m: Annotated[float, within(limits.DAMPING_NS_PER_M, "damping against the intended speed", 5.0)] = 5.0
    stiffness_n_per_m: Annotated[
        float, Meta(ge=0.0, le=limits.STIFFNESS_N_PER_M.high, description="pull per way to the intended place")
    ] = 500.0


class Options(Table, frozen=True, kw_only=True):
    """What a rig's [device] table may say for `driver = "simulated"`; what is left out is the preset's."""

    preset: Annotated[Literal["omega.3", "omega.6", "falcon"], said("device whose numbers are taken", "omega.6")] = (
        "omega.6"
    )
    mass_kg: Annotated[tuple[Mass, Mass, Mass], said("apparent mass along x, y, z")] | None = None
    damping_ns_per_m: Annotated[tuple[Damping, Damping, Damping], said("viscous damping")] | None = None
    friction_n: Annotated[tuple[Friction, Friction, Friction], said("Coulomb friction of the mechanism")] | None = None
    lag_s: Annotated[float, within(limits.LAG_S, "time constant of the amplifiers")] | None = None
    force_max_n: Annotated[float, within(limits.FORCE_MAX_N, "most that the motors give; direction kept")] | None = None
    delay_ticks: Annotated[int, within(limits.DELAY_TICKS, "ticks until a force written acts")] | None = None
    resolution_m: Annotated[float, within(limits.RESOLUTION_M, "step of the encoders; 0: none")] | None = None
    orientation_lag_s: Annotated[float, within(limits.LAG_S, "time constant of the sensed orientation")] = 0.0
    hand: Hand = Hand()
    recording: Annotated[str, said("poses the hand intends: file or shipped recording", RECORDING)] | None = None
    loop: Annotated[bool, said("start again at the end, over a smooth return; false: stop after one pass")] = True
    position_m: Annotated[tuple[Coordinate, Coordinate, Coordinate], said("where the hand stays instead")] | None = None
    sway_m: Annotated[tuple[Coordinate, Coordinate, Coordinate], said("amplitude of a sinusoid about it")] = (0, 0, 0)
    sway_hz: Annotated[float, within(limits.MOTION_FREQUENCY_HZ, "cycles per second of the sinusoid")] = 0.0
    sway_phase_rad: Annotated[float, within(limits.ANGLE_RAD, "where in its cycle it starts")] = 0.0
    forces: Annotated[str, said("file (.csv or .npz) for the wrenches written, saved on close")] | None = None

    def faults(self) -> Any:
        if known(self.recording, self.position_m) and self.recording is not None and self.position_m is not None:
            yield "position_m", self.position_m, "the hand follows a recording: leave one of the two out"


class Simulation(NamedTuple):
    """A device ready to be computed: plant, state at tick 0, intention and its poses (7 length,), all for one rate."""

    plant: Plant
    state: PlantState
    intention: Intention
    poses: Array


def simulation(options: Options, rate_hz: float) -> Simulation:
    """The numbers of a preset with what the options change; RecordingError when the recording cannot be used."""
    preset = presets()[options.preset]

    def chosen(key: str) -> Any:
        given = getattr(options, key)
        return getattr(preset, key) if given is None else given

    plant = make_plant(
        1.0 / rate_hz,
        mass=chosen("mass_kg"),
        damping=chosen("damping_ns_per_m"),
        friction=chosen("friction_n"),
        lag=chosen("lag_s"),
        force_max=chosen("force_max_n"),
        delay=chosen("delay_ticks"),
        resolution=chosen("resolution_m"),
        hand_mass=options.hand.mass_kg,
        hand_damping=options.hand.damping_ns_per_m,
        hand_stiffness=options.hand.stiffness_n_per_m,
        orientation_lag=options.orientation_lag_s,
    )
    poses = _intended(options, preset, rate_hz)
    x, y, z = (float(a) for a in options.sway_m)
    turns = options.sway_phase_rad / (2.0 * np.pi)
    intention = Intention(float(len(poses)), float(options.loop), (x, y, z), options.sway_hz / rate_hz, float(turns))
    flat = np.ascontiguousarray(poses).reshape(-1)
    position, orientation = goal_at(intention, flat, 0)
    return Simulation(plant, at_rest(position, orientation), intention, flat)


def _intended(options: Options, preset: Preset, rate_hz: float) -> Array:
    if options.position_m is not None:
        return np.array([[*options.position_m, 1.0, 0.0, 0.0, 0.0]])
    samples = resample(load_poses(options.recording or RECORDING), rate_hz)
    poses = close_loop(samples, rate_hz) if options.loop else samples
    if preset.sensed_dof < 6:
        poses[:, 3:] = 1.0, 0.0, 0.0, 0.0
    return poses


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
