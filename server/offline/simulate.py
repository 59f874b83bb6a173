"""The servo's tick offline, over recorded poses or with simulated devices."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, overload

import msgspec
import numpy as np

from softfinger.config import schema
from softfinger.config.arrays import Array
from softfinger.config.errors import ConfigError
from softfinger.config.load import SceneSource, build, load_rig, load_scene
from softfinger.config.schema.pairing import FingerDevice, pair_devices
from softfinger.drivers import registry
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import resample
from softfinger.proxy.bodies import begin_bodies, check_bodies
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.jit.pack import PackedTree, pack, packed, unpack
from softfinger.proxy.kernels.jit.tuples import rows_of
from softfinger.proxy.kernels.query.bodies import step_bodies
from softfinger.proxy.pose_checks import check_poses
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.proxy.records import Records
from softfinger.server.loop.clock import NS_PER_S, compute_period_ns
from softfinger.server.loop.tick import Tuning, make_start_memory, run_tick
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.scene_messages import NO_MESSAGES, SceneMessages
from softfinger.server.progress import CHUNK, show_progress


@entry
def run_ticks(
    tuning_packed: PackedTree,
    memory_packed: PackedTree,
    poses: Array,
    dts: Array,
    period: float,
    first: int,
    records: Array,
) -> None:
    """Run a tick for each of `poses` (n, fingers, 7), `dts` (n,) s after the previous one, and write `records`.

    tuning_packed  Tuning
    memory_packed  Memory; `like` is the initial one, `values` are the current values, which are updated
    period         s  nominal period of a tick, which advances ramp and slew limit of the guard
    """
    start = memory_packed.like
    tuning = unpack(tuning_packed.like, tuning_packed.values)
    memory = unpack(start, memory_packed.values)
    for i in range(poses.shape[0]):
        samples, rows = rows_of(memory.fingers, poses[i], 0), rows_of(memory.fingers, records[i], 0)
        memory = run_tick(tuning, start, memory, samples, dts[i], period, first + i, rows)
        step_bodies(tuning.scene.bodies)
    pack(memory_packed.values, memory)


def simulate(tuning: Tuning, poses: Array, rate_hz: float) -> Array:
    """Run the servo's tick over poses, and return the records that the daemon would produce.

    Parameters
    ----------
    tuning
        Scene and guard.
    poses
        (n, 7) position, m, and orientation w, x, y, z, one per tick; (n, fingers, 7) with several fingers.
    rate_hz
        Ticks per second.

    Returns
    -------
    Array
        Records (n, RECORD_SIZE), or (n, fingers, RECORD_SIZE). The timestamp is the tick times dt; the fields of servo
        timing and device are 0.
    """
    finger_poses = poses[:, None] if poses.ndim < 3 else poses
    records, at = np.empty((*finger_poses.shape[:2], RECORD_SIZE)), 0
    for block in simulate_poses(tuning, finger_poses, rate_hz):
        records[at : at + len(block)] = block
        at += len(block)
    return records[:, 0] if poses.ndim < 3 else records


def simulate_poses(
    tuning: Tuning, poses: Array, rate_hz: float, messages: SceneMessages = NO_MESSAGES
) -> Iterator[Array]:
    """Simulate poses (n, fingers, 7), and yield the records in blocks (m, fingers, RECORD_SIZE).

    A block has at most CHUNK ticks. A caller that processes each block at once needs the memory of one for a run of any
    length.

    messages  receives the messages of the scene's topics; those of a block are complete when it is yielded
    """
    for index in range(poses.shape[1]):
        check_poses(poses[:, index])
    dt = compute_period_ns(rate_hz) / NS_PER_S
    dts = np.full(min(len(poses), CHUNK), dt)
    begin_bodies(tuning.scene, dt)
    scene_and_guard, memory = packed(tuning), packed(make_start_memory(tuning.scene))
    with show_progress("simulating", len(poses)) as advance:
        for first in range(0, len(poses), CHUNK):
            block = np.ascontiguousarray(poses[first : first + CHUNK])
            records = np.zeros((*block.shape[:2], RECORD_SIZE))
            records[:, :, AT.timestamp] = np.arange(first, first + len(block))[:, None] * dt
            for first_tick, part in messages.split(tuning.scene, first, records):
                run_ticks(scene_and_guard, memory, block[part], dts, dt, first_tick, records[part])
                check_bodies(tuning.scene)
            yield records
            advance(first + len(block))


@overload
def run_recording(
    recording: Mapping[str, str | Path],
    scene: SceneSource = ...,
    *,
    overrides: Mapping[str, Any] | None = ...,
    rig: str | Path = ...,
    rate_hz: float | None = ...,
) -> dict[str, Records]: ...


@overload
def run_recording(
    recording: str | Path,
    scene: SceneSource = ...,
    *,
    overrides: Mapping[str, Any] | None = ...,
    rig: str | Path = ...,
    rate_hz: float | None = ...,
) -> Records: ...


def run_recording(
    recording: str | Path | Mapping[str, str | Path],
    scene: SceneSource = "paper-plane",
    *,
    overrides: Mapping[str, Any] | None = None,
    rig: str | Path = "replay",
    rate_hz: float | None = None,
) -> Records | dict[str, Records]:
    """Run the servo's tick over recorded poses, with records equal bit for bit to the daemon's.

    `softfinger simulate` computes the same.

    Parameters
    ----------
    recording
        File (.csv, .npz, .mcap) or name of a shipped recording; with several fingers a mapping by finger name.
    scene, overrides
        As for `load_scene`.
    rig
        File or name of a shipped rig; its guard limits the force.
    rate_hz
        Ticks per second in place of the rig's.

    Returns
    -------
    Records or dict of Records
        Records (n, RECORD_SIZE), one row per tick, with fields by name; with several fingers a mapping by finger name.

    Raises
    ------
    ConfigError, RecordingError
        If scene, rig or recording is unusable.

    Examples
    --------
    >>> from softfinger import run_recording
    >>> slippery = {"object.table.material.friction": {"static": 0.2, "kinetic": 0.1}}
    >>> records = run_recording("press-roll-spin-drag", "paper-plane", overrides=slippery)
    >>> sorted(set(records["contact.mode"].tolist()))   # free, rolling, sliding
    [0, 1, 2]
    """
    loaded_scene = load_scene(scene, overrides)
    loaded_rig = load_rig(rig, {} if rate_hz is None else {"servo.rate_hz": rate_hz})
    fingers = [finger.name for finger in loaded_scene.fingers]
    recordings = recording if isinstance(recording, Mapping) else {"": recording}
    poses = load_finger_poses(fingers, recordings, loaded_rig.servo.rate_hz)
    records = simulate(make_tuning(loaded_scene, loaded_rig.guard), poses, loaded_rig.servo.rate_hz)
    results = {name: Records(np.ascontiguousarray(records[:, index])) for index, name in enumerate(fingers)}
    return results if isinstance(recording, Mapping) else results[fingers[0]]


def load_finger_poses(fingers: Sequence[str], recordings: Mapping[str, str | Path], rate_hz: float) -> Array:
    """Load and resample the poses of all fingers.

    Parameters
    ----------
    fingers
        Names of the scene's fingers.
    recordings
        Recording of each finger by name. The empty name refers to the recording of a single finger, or to an MCAP
        recording of all fingers.
    rate_hz
        Ticks per second of the result.

    Returns
    -------
    Array
        Poses (n, fingers, 7), as long as the shortest recording.

    Raises
    ------
    ConfigError
        Unless each finger has a recording.
    RecordingError
        If a recording is unusable.
    """
    has_fingers = len(fingers) > 1
    has_one_file = set(recordings) == {""} and (not has_fingers or Path(recordings[""]).suffix.lower() == ".mcap")
    if not has_one_file and set(recordings) != set(fingers):
        expected_fingers = ", ".join(filter(None, fingers)) or "one, without its name"
        given_fingers = ", ".join(map(str, filter(None, recordings))) or "a single finger"
        remedy = " ".join(f"--poses {name}=FILE" for name in fingers) if has_fingers else "--poses FILE"
        raise ConfigError(
            f"poses of {given_fingers} do not match the fingers of the scene: use poses of {expected_fingers}, "
            f"such as {remedy}"
        )
    poses_of_fingers = [
        resample(
            load_poses(recordings["" if has_one_file else name], name if has_one_file and has_fingers else ""), rate_hz
        )
        for name in fingers
    ]
    count = min(map(len, poses_of_fingers))
    return np.stack([poses[:count] for poses in poses_of_fingers], axis=1)


def simulate_devices(
    scene: schema.Scene, rig: schema.Rig, seconds: float, messages: SceneMessages = NO_MESSAGES
) -> Iterator[Array]:
    """Simulate a scene with the rig's simulated devices, and yield records in blocks (m, fingers, RECORD_SIZE).

    Raises ConfigError if a device is not simulated, or if a finger has no device.
    """
    # Compiled on import, which a run over poses does not need.
    from softfinger.server.offline.closed_loop import run_closed_loop

    rate, pairs = rig.servo.rate_hz, pair_devices(scene, rig)
    with ExitStack() as stack:
        devices = [stack.enter_context(_open_simulated(paired, rate)) for paired in pairs]
        ticks = max(1, round(seconds * rate))
        tuning = make_tuning(
            scene, rig.guard, [device.info for device in devices], [paired.device.tool for paired in pairs]
        )
        simulations = [device.simulation for device in devices]
        lengths = [int(plant.intention.length) for plant in simulations if not plant.intention.loop]
        yield from run_closed_loop(tuning, simulations, rate, min([ticks, *lengths]), messages)


def _open_simulated(paired: FingerDevice, rate_hz: float) -> Any:
    """Return the opened device of a finger. Raises ConfigError if it needs a clock."""
    config = paired.device
    driver = registry.load(config.driver)
    if not hasattr(driver, "make_simulation"):
        raise ConfigError(f"device '{config.driver}' cannot run offline: use the device `simulated`, or --poses")
    options = build(driver.Options, config.options, paired.table)
    if getattr(options, "puck", None) is not None:
        raise ConfigError("a hand moved by a SpaceMouse cannot run offline: use `run`, or remove puck")
    # The records contain the forces; a file of forces written by a servo would be empty.
    return driver.open_device(msgspec.structs.replace(options, forces=None), rate_hz)
