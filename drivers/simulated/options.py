"""Configuration of a simulated device, and the resulting numbers of its plant and hand.

Separate from the device, because a study without a clock needs these but no C functions.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from math import pi
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple

import msgspec
import numpy as np
from msgspec import Meta

from softfinger.config import limits
from softfinger.config.arrays import Array
from softfinger.config.schema import Complaint, Point, Table, doc, is_usable, within
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import close_loop, resample
from softfinger.drivers.simulated.plant import (
    Handle,
    Impedance,
    Intention,
    Plant,
    PlantState,
    compute_goal,
    make_plant,
    make_rest_state,
)
from softfinger.drivers.spacemouse.puck import Options as PuckOptions

PRESETS_FILE: Final = Path(__file__).resolve().with_name("presets.toml")


class Preset(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Parameters of one simulated device; docs/devices/simulated.md gives each number and its source."""

    name: str
    sensed_dof: int
    mass_kg: tuple[float, float, float]
    damping_ns_per_m: tuple[float, float, float]
    friction_n: tuple[float, float, float]
    lag_s: float
    force_max_n: float
    delay_ticks: int
    resolution_m: float
    stiffness_max_n_per_m: float
    damping_max_ns_per_m: float
    workspace_radius_m: float


@lru_cache(maxsize=1)
def load_presets() -> dict[str, Preset]:
    """Return all presets by name; the file is read when a simulated device is first opened."""
    return msgspec.toml.decode(PRESETS_FILE.read_bytes(), type=dict[str, Preset])


RECORDING: Final = "press-roll-spin-drag"
"""Default motion of the hand."""

Mass = Annotated[float, Meta(ge=limits.MASS_KG.low, le=limits.MASS_KG.high)]
Damping = Annotated[float, Meta(ge=limits.DAMPING_NS_PER_M.low, le=limits.DAMPING_NS_PER_M.high)]
Friction = Annotated[float, Meta(ge=limits.DEVICE_FRICTION_N.low, le=limits.DEVICE_FRICTION_N.high)]


class Hand(Table, frozen=True, kw_only=True):
    """Hand on the handle: a mass that moves with the handle, and a spring and damper towards the intended pose."""

    mass_kg: Annotated[float, within(limits.HAND_MASS_KG, "mass that moves with the handle", 0.1)] = 0.1
    damping_ns_per_m: Annotated[float, within(limits.DAMPING_NS_PER_M, "damping against the intended speed", 8.0)] = 8.0
    stiffness_n_per_m: Annotated[
        float, Meta(ge=0.0, le=limits.STIFFNESS_N_PER_M.high, description="spring to the intended position")
    ] = 1000.0


class Options(Table, frozen=True, kw_only=True):
    """Keys of a rig's [device] with `driver = "simulated"`; missing keys take the values of the preset."""

    preset: Annotated[Literal["omega.3", "omega.6", "falcon"], doc("device with these data", "omega.6")] = "omega.6"
    mass_kg: Annotated[tuple[Mass, Mass, Mass], doc("apparent mass along x, y, z")] | None = None
    damping_ns_per_m: Annotated[tuple[Damping, Damping, Damping], doc("viscous damping")] | None = None
    friction_n: Annotated[tuple[Friction, Friction, Friction], doc("Coulomb friction of the mechanism")] | None = None
    lag_s: Annotated[float, within(limits.LAG_S, "time constant of the amplifiers")] | None = None
    force_max_n: (
        Annotated[float, within(limits.FORCE_MAX_N, "largest force of the motors; the direction is preserved")] | None
    ) = None
    delay_ticks: Annotated[int, within(limits.DELAY_TICKS, "ticks until a force written acts")] | None = None
    resolution_m: Annotated[float, within(limits.RESOLUTION_M, "step of the encoders; 0: none")] | None = None
    orientation_lag_s: Annotated[float, within(limits.LAG_S, "time constant of the sensed orientation")] = 0.0
    hand: Hand = Hand()
    recording: Annotated[str, doc("poses the hand intends: file or shipped recording", RECORDING)] | None = None
    loop: Annotated[bool, doc("start again at the end, over a smooth return; false: stop after one pass")] = True
    position_m: Annotated[Point, doc("fixed position of the hand instead")] | None = None
    sway_m: Annotated[Point, doc("amplitude of a sinusoid about it")] = (0.0, 0.0, 0.0)
    sway_hz: Annotated[float, within(limits.MOTION_FREQUENCY_HZ, "cycles per second of the sinusoid")] = 0.0
    sway_phase_rad: Annotated[float, within(limits.ANGLE_RAD, "initial phase of the sinusoid")] = 0.0
    puck: Annotated[PuckOptions, doc("a SpaceMouse moves the intended position instead")] | None = None
    forces: Annotated[str, doc("file (.csv or .npz) for the wrenches written, saved on close")] | None = None

    def faults(self) -> Iterator[Complaint]:
        if is_usable(self.recording, self.position_m) and self.recording is not None and self.position_m is not None:
            yield "position_m", self.position_m, "the hand follows a recording: remove one of the two"
        if is_usable(self.loop, self.position_m, self.puck) and not self.loop and (self.position_m or self.puck):
            yield (
                "loop",
                self.loop,
                "only a hand that follows a recording stops after one pass: leave out `loop` and --once",
            )
        if not is_usable(self.puck) or self.puck is None:
            return
        for key in ("recording", "position_m"):
            if is_usable(getattr(self, key)) and getattr(self, key) is not None:
                yield key, getattr(self, key), "the hand follows the SpaceMouse: remove one of the two"


class Simulation(NamedTuple):
    """Complete simulation for one rate: plant, state at tick 0, intention and its poses (7 length,)."""

    plant: Plant
    state: PlantState
    intention: Intention
    poses: Array


def make_simulation(options: Options, rate_hz: float) -> Simulation:
    """Return a preset changed by the options; raises RecordingError if the recording cannot be used."""
    preset = load_presets()[options.preset]

    def choose(key: str) -> Any:
        value = getattr(options, key)
        return getattr(preset, key) if value is None else value

    handle = Handle(
        mass=choose("mass_kg"),
        damping=choose("damping_ns_per_m"),
        friction=choose("friction_n"),
        lag=choose("lag_s"),
        force_max=choose("force_max_n"),
        delay=choose("delay_ticks"),
        resolution=choose("resolution_m"),
        orientation_lag=options.orientation_lag_s,
    )
    hand = Impedance(options.hand.mass_kg, options.hand.damping_ns_per_m, options.hand.stiffness_n_per_m)
    plant = make_plant(1.0 / rate_hz, handle, hand)
    poses = _make_poses(options, preset, rate_hz)
    x, y, z = (float(a) for a in options.sway_m)
    turns = options.sway_phase_rad / (2.0 * pi)
    intention = Intention(float(len(poses)), float(options.loop), (x, y, z), options.sway_hz / rate_hz, float(turns))
    flat = np.ascontiguousarray(poses).reshape(-1)
    position, orientation = compute_goal(intention, flat, 0)
    return Simulation(plant, make_rest_state(position, orientation), intention, flat)


def _make_poses(options: Options, preset: Preset, rate_hz: float) -> Array:
    fixed_position = options.position_m if options.puck is None else options.puck.start_m
    if fixed_position is not None:
        return np.array([[*fixed_position, 1.0, 0.0, 0.0, 0.0]])
    samples = resample(load_poses(RECORDING if options.recording is None else options.recording), rate_hz)
    poses = close_loop(samples, rate_hz) if options.loop else samples
    if preset.sensed_dof < 6:
        poses[:, 3:] = 1.0, 0.0, 0.0, 0.0
    return poses
