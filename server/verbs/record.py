"""`softfinger record`: record a running daemon, or only its poses as a table that the replay device plays.

Only a client of the wire.
"""

from __future__ import annotations

import argparse
import logging
import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any, Final

import numpy as np

from softfinger.config.arrays import Array
from softfinger.config.errors import ConfigError, RecordingError
from softfinger.config.files import is_same_file
from softfinger.drivers.closeable import Closeable
from softfinger.drivers.poses import DT_MAX_S, DT_MIN_S, find_rate
from softfinger.proxy.record import AT
from softfinger.server import keys, signals
from softfinger.server.arguments import parse_files_by_finger
from softfinger.server.gateway.addresses import Addresses, find_addresses
from softfinger.server.recording.live import RecordingJob, TickBatcher, receive_full_tick, record_live, record_until_end
from softfinger.server.recording.poses_file import POSE, PosesFile, open_poses_file
from softfinger.server.wire.client import Subscription, subscribe
from softfinger.server.wire.protocol import CONTACT, EVENT, FINGERS, ProtocolError, find_finger

log: Final = logging.getLogger(__name__)

BUFFERED_POSES: Final = 200
"""Poses buffered at the start to determine the loop's period: `dt` of a late tick covers more than one period."""


def run(args: argparse.Namespace) -> int:
    if (args.file is None) == (args.poses is None):
        raise ConfigError("record needs either a FILE or --poses FILE")
    stop, lock = threading.Event(), keys.read_keys(args)
    addresses = find_addresses(args.endpoint, lock, args.commands, within_s=args.timeout)
    if args.file is not None and Path(args.file).suffix.lower() == ".mcap":
        job = RecordingJob(addresses, lock, args.duration, args.timeout, stop.is_set)
        with signals.stop_on_signal(stop.set):
            log.info("%s", record_live(job, Path(args.file)))
        return signals.stop_exit_code()
    files = {name: Path(file) for name, file in parse_files_by_finger(args.poses or [args.file], "--poses").items()}
    for (name, file), (second_name, second_file) in combinations(files.items(), 2):
        if is_same_file(file, second_file):
            raise ConfigError(
                f"--poses {name}={file} and --poses {second_name}={second_file} are the same file: use two names"
            )
    topics = CONTACT, FINGERS, EVENT
    with subscribe(addresses.telemetry, topics, keys=lock) as samples, signals.stop_on_signal(stop.set):
        recorded = record(samples, files, args.duration, args.timeout, stop.is_set)
    for name, stats in recorded.items():
        log.info("%s: %s", files[name], stats)
        if stats.lost:
            log.warning("%s", stats.gaps())
    return signals.stop_exit_code()


@dataclass
class RecordingStats:
    """Statistics of one recording.

    first_tick, last_tick  of the server, -1 before the first
    poses                  rows written
    lost, gap_count        published ticks between them that did not arrive, and the number of gaps
    worst                  (tick before it, ticks lost) of the longest gap
    unusable               poses skipped because they are not finite
    every                  one tick in `every` is published
    seconds                time from first to last row
    end_reason             reason for the end of the recording
    """

    first_tick: int = -1
    last_tick: int = -1
    poses: int = 0
    lost: int = 0
    gap_count: int = 0
    worst: tuple[int, int] = (-1, 0)
    unusable: int = 0
    every: int = 1
    seconds: float = 0.0
    end_reason: str = ""

    def __str__(self) -> str:
        thinning = f", one in {self.every}" if self.every > 1 else ""
        losses = "" if self.lost else ", no tick lost"
        skipped = f", {self.unusable} skipped that are no valid pose" if self.unusable else ""
        ticks = f"ticks {self.first_tick} to {self.last_tick}{thinning}"
        return f"{self.poses} poses of {ticks}, {self.seconds:.3f} s{losses}{skipped}; {self.end_reason}"

    def gaps(self) -> str:
        return (
            f"{self.lost} ticks in {self.gap_count} gaps did not arrive, the longest {self.worst[1]} after tick "
            f"{self.worst[0]}: a replay interpolates each; record on a machine with less load, or with "
            "[telemetry] every above 1"
        )


def record(
    samples: Subscription,
    files: Mapping[str, Path],
    duration_s: float | None = None,
    timeout_s: float = 3.0,
    is_stopped: Callable[[], bool] = lambda: False,
) -> dict[str, RecordingStats]:
    """Write the poses of each finger until `duration_s` of ticks, the end of the server, or a stop.

    A single finger has the name "". Raises NoTelemetry if nothing arrives within `timeout_s` at the start, and
    ConfigError if the server has other fingers. A later silence of `timeout_s` ends the recording.
    """
    job = RecordingJob(Addresses(samples.endpoint, None), None, duration_s, timeout_s, is_stopped)
    first_samples, fingers = receive_full_tick(samples, job)
    if not files.keys() <= set(fingers):
        remedy = (
            "one: --poses FILE"
            if fingers == [""]
            else f"several fingers, such as {fingers[0]}: --poses {fingers[0]}=FILE"
        )
        raise ConfigError(f"--poses of {', '.join(files) or 'one finger'}: the server has {remedy}")
    every = first_samples[-1].every
    if len(fingers) > 1:  # messages of the first tick may have been missed: all recordings start at the next tick
        ticks = [sample for sample in first_samples if find_finger(sample.topic) is not None]
        first_samples = [sample for sample in ticks if sample.tick > ticks[0].tick]
    with ExitStack() as stack:
        writers = {name: stack.enter_context(PoseWriter(open_poses_file(path), every)) for name, path in files.items()}
        end_reason = record_until_end(samples, job, first_samples, TickBatcher(PoseReceiver(writers), list(files)))
    for name, writer in writers.items():
        writer.stats.end_reason = end_reason
        if writer.stats.poses < 2:
            files[name].unlink(missing_ok=True)
            raise RecordingError(
                f"{files[name]}: {writer.stats.poses} pose(s) arrived ({end_reason}), a recording has at least 2"
            )
    return {name: writer.stats for name, writer in writers.items()}


class PoseWriter(Closeable):
    """Assigns a time to each pose and writes it to the file.

    The time of a row is an integer number of loop periods: the periods in the `dt` of each tick, and one for each tick
    between. A replay at the same rate therefore plays one pose per tick. Rounded wall-clock times would not guarantee
    that. Leaving the context completes the file.
    """

    def __init__(self, file: PosesFile, every: int) -> None:
        self.stats = RecordingStats(every=every)
        self._file, self._period, self._periods = file, 0.0, 0.0
        self._buffer: list[Array] = []

    def add(self, records: Array) -> None:
        """Add the next records (n, RECORD_SIZE)."""
        self._buffer.append(records)
        if self._period or sum(map(len, self._buffer)) >= BUFFERED_POSES:
            self.flush()

    def close(self) -> None:
        try:
            self.flush()
        finally:
            self._file.close()

    def flush(self) -> None:
        if not self._buffer:
            return
        stats, records = self.stats, np.concatenate(self._buffer)
        self._buffer.clear()
        ticks, dts = records[:, AT.tick].astype(int), records[:, AT.dt]
        for tick, dt in zip(ticks.tolist(), dts.tolist(), strict=True):
            if not DT_MIN_S <= dt <= DT_MAX_S:
                raise ProtocolError(
                    f"tick {tick} has dt = {dt:g} s: outside the range of a loop ({DT_MIN_S:g} to {DT_MAX_S:g}): check "
                    "that this program sent it"
                )
        self._period = self._period or float(dts.min())
        if stats.first_tick < 0:
            stats.first_tick = stats.last_tick = int(ticks[0])
        steps = np.diff(ticks, prepend=stats.last_tick)
        gaps = np.maximum((steps - 1) // stats.every, 0)
        stats.lost, stats.gap_count = stats.lost + int(gaps.sum()), stats.gap_count + int(np.count_nonzero(gaps))
        longest = int(gaps.argmax())
        if gaps[longest] > stats.worst[1]:
            stats.worst = int(ticks[longest] - steps[longest]), int(gaps[longest])
        periods = np.where(steps > 0, steps - 1 + np.maximum(1.0, np.rint(dts / self._period)), 0.0)
        elapsed = self._periods + np.cumsum(periods)
        times, is_valid = elapsed / find_rate(self._period), np.isfinite(records[:, POSE]).all(axis=1)
        self._file.add(times[is_valid], records[is_valid])
        self._periods, stats.last_tick, stats.seconds = elapsed[-1], int(ticks[-1]), float(times[-1])
        stats.poses += int(is_valid.sum())
        stats.unusable += int((~is_valid).sum())


class PoseReceiver:
    """Passes the ticks of each finger to its writer, and ignores all other messages."""

    def __init__(self, writers: Mapping[str, PoseWriter]) -> None:
        self._writers = writers

    def ticks(self, records: Array, finger: str) -> None:
        self._writers[finger].add(records)

    def event(self, event: Mapping[str, Any]) -> None: ...

    def message(self, topic: str, message: Mapping[str, Any]) -> None: ...
