"""The servo's tick offline: over poses, or with devices that are computed."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any, overload

import msgspec
import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.config.load import SceneSource, build, load_rig, load_scene
from softfinger.config.schema.pairing import Moved, pair
from softfinger.drivers import registry
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import resample
from softfinger.proxy.bodies import begin_bodies, check_bodies
from softfinger.proxy.engine import check_poses
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.jit.pack import Packed, pack, packed, unpack
from softfinger.proxy.kernels.jit.tuples import rows_of
from softfinger.proxy.kernels.query.bodies import step_bodies
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.proxy.records import Records
from softfinger.server.loop.clock import NS_PER_S, period_ns
from softfinger.server.loop.tick import Tuning, begin, tick
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.progress import CHUNK, progress

Array = NDArray[np.float64]


@entry
def tick_many(
    tuning_packed: Packed,
    memory_packed: Packed,
    poses: Array,
    dts: Array,
    period: float,
    first: int,
    records: Array,
) -> None:
    """One tick for each of `poses` (n, fingers, 7), `dts` (n,) s after the one before, with a record each in `records`.

    tuning_packed  Tuning
    memory_packed  Memory, as it is before the first tick of all; its leaves are those of now, and carried on
    period         s  nominal length of a tick, what ramp and slew limit of the guard advance by
    """
    start = memory_packed.like
    tuning = unpack(tuning_packed.like, tuning_packed.values)
    memory = unpack(start, memory_packed.values)
    for i in range(poses.shape[0]):
        samples, rows = rows_of(memory.fingers, poses[i], 0), rows_of(memory.fingers, records[i], 0)
        memory = tick(tuning, start, memory, samples, dts[i], period, first + i, rows)
        step_bodies(tuning.scene.bodies)
    pack(memory_packed.values, memory)


def simulate(tuning: Tuning, poses: Array, rate_hz: float) -> Array:
    """Records (n, RECORD_SIZE) of the poses (n, 7), one tick each, as the daemon computes them.

    Of several fingers: records (n, fingers, RECORD_SIZE) of poses (n, fingers, 7). The timestamp is the tick
    times dt, and the fields of servo timing and device are 0.
    """
    given = poses[:, None] if poses.ndim < 3 else poses
    records, at = np.empty((*given.shape[:2], RECORD_SIZE)), 0
    for block in over_poses(tuning, given, rate_hz):
        records[at : at + len(block)] = block
        at += len(block)
    return records[:, 0] if poses.ndim < 3 else records


def over_poses(tuning: Tuning, poses: Array, rate_hz: float) -> Iterator[Array]:
    """Simulate poses (n, fingers, 7), and yield the records in blocks (m, fingers, RECORD_SIZE).

    A block has at most CHUNK ticks. A caller who does not keep them needs the memory of one, however long the run.
    """
    for place in range(poses.shape[1]):
        check_poses(poses[:, place])
    dt = period_ns(rate_hz) / NS_PER_S
    dts = np.full(min(len(poses), CHUNK), dt)
    begin_bodies(tuning.scene, dt)
    scene_and_guard, memory = packed(tuning), packed(begin(tuning.scene))
    with progress("simulating", len(poses)) as done:
        for first in range(0, len(poses), CHUNK):
            some = np.ascontiguousarray(poses[first : first + CHUNK])
            records = np.zeros((*some.shape[:2], RECORD_SIZE))
            records[:, :, AT.timestamp] = np.arange(first, first + len(some))[:, None] * dt
            tick_many(scene_and_guard, memory, some, dts, dt, first, records)
            check_bodies(tuning.scene)
            yield records
            done(first + len(some))


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
    """The servo's tick over recorded poses, as `softfinger simulate` computes it, and the daemon: to the same bits.

    recording  a file (.csv, .npz, .mcap) or the name of a shipped one; of several fingers a mapping of each by name
    scene      what `load_scene` takes; `overrides` are its too
    rig        file or shipped name: its guard limits the force
    rate_hz    ticks per second in place of the rig's

    Returns records (n, RECORD_SIZE), a row a tick, fields by name; of several fingers those of each by name. Raises
    ConfigError and RecordingError with what is wrong.

    >>> from softfinger import run_recording
    >>> slippery = {"object.table.material.friction": {"static": 0.2, "kinetic": 0.1}}
    >>> records = run_recording("press-roll-spin-drag", "paper-plane", overrides=slippery)
    >>> sorted(set(records["contact.mode"].tolist()))   # free, rolling, sliding
    [0, 1, 2]
    """
    made, limits = load_scene(scene, overrides), load_rig(rig, {} if rate_hz is None else {"servo.rate_hz": rate_hz})
    if isinstance(recording, Mapping):
        return over_recordings(made, limits, recording)
    return over_recordings(made, limits, {"": recording})[made.fingers[0].name]


def over_recordings(scene: schema.Scene, rig: schema.Rig, recordings: Mapping[str, str | Path]) -> dict[str, Records]:
    """Records of each finger by its name, at the rig's rate; ConfigError unless each has a recording."""
    fingers = [finger.name for finger in scene.fingers]
    poses = poses_of(fingers, recordings, rig.servo.rate_hz)
    together = simulate(make_tuning(scene, rig.guard), poses, rig.servo.rate_hz)
    return {name: Records(np.ascontiguousarray(together[:, place])) for place, name in enumerate(fingers)}


def poses_of(fingers: Sequence[str], recordings: Mapping[str, str | Path], rate_hz: float) -> Array:
    """Poses (n, fingers, 7) at the rate, as long as the shortest recording; ConfigError unless each finger has one.

    Under no name: that of the only finger, or an MCAP recording of all.
    """
    several = len(fingers) > 1
    whole = set(recordings) == {""} and (not several or Path(recordings[""]).suffix.lower() == ".mcap")
    if not whole and set(recordings) != set(fingers):
        wanted = ", ".join(filter(None, fingers)) or "one, without its name"
        given = ", ".join(filter(None, recordings)) or "a single finger"
        raise ConfigError(f"poses of {given}: not the scene's fingers: give poses of {wanted}")
    each = [
        resample(load_poses(recordings["" if whole else name], name if whole and several else ""), rate_hz)
        for name in fingers
    ]
    count = min(map(len, each))
    return np.stack([poses[:count] for poses in each], axis=1)


def with_devices(scene: schema.Scene, rig: schema.Rig, seconds: float) -> Iterator[Array]:
    """Simulate a scene felt through the rig's simulated devices, and yield records in blocks (m, fingers, RECORD_SIZE).

    Raises ConfigError for a device that is not computed, and for fingers without one.
    """
    # Compiled when imported, which a run over poses need not wait for.
    from softfinger.server.offline.closed_loop import run_closed_loop

    rate, pairs = rig.servo.rate_hz, pair(scene, rig)
    with ExitStack() as opened:
        devices = [opened.enter_context(_computed(each, rate)) for each in pairs]
        ticks = max(1, round(seconds * rate))
        once = [int(each.simulation.intention.length) for each in devices if not each.simulation.intention.loop]
        tuning = make_tuning(scene, rig.guard, [each.info for each in devices], [each.device.tool for each in pairs])
        yield from run_closed_loop(tuning, [each.simulation for each in devices], rate, min([ticks, *once]))


def _computed(moved: Moved, rate_hz: float) -> Any:
    """The device of a finger, opened; ConfigError for one that needs a clock."""
    config = moved.device
    driver = registry.load(config.driver)
    if not hasattr(driver, "simulation"):
        raise ConfigError(
            f"device '{config.driver}' cannot be run without a clock: take the device `simulated`, or --poses"
        )
    options = build(driver.Options, config.options, moved.table)
    if getattr(options, "puck", None) is not None:
        raise ConfigError("a hand that a puck leads cannot be run without a clock: use `run`, or leave puck out")
    # The records hold the forces; a file of what a servo wrote would be empty.
    return driver.open_device(msgspec.structs.replace(options, forces=None), rate_hz)
