"""`softfinger record`: record a running daemon, or only its poses as a table that the replay device plays.

Only a client of the wire. Rows are written as they arrive, so that a kill loses none that arrived before.
"""

from __future__ import annotations

import argparse
import logging
import math
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Final

from softfinger.config.errors import ConfigError, RecordingError
from softfinger.config.files import is_same_file
from softfinger.drivers.closing import Closeable
from softfinger.drivers.poses import DT_MAX_S, DT_MIN_S, find_rate
from softfinger.server import keys, signals
from softfinger.server.arguments import parse_files_by_finger
from softfinger.server.gateway.addresses import find_addresses
from softfinger.server.progress import show_counter
from softfinger.server.recording.poses_file import PosesFile, open_poses_file
from softfinger.server.recording.verbs.live import RecordingJob, record_live
from softfinger.server.wire.client import NoTelemetry, Sample, Subscription, explain_no_telemetry, subscribe
from softfinger.server.wire.protocol import CONTACT, EVENT, FINGERS, ProtocolError, find_finger

log: Final = logging.getLogger(__name__)

BUFFERED_POSES: Final = 200
"""Poses buffered at the start to determine the loop's period: `dt` of a late tick covers more than one period."""
POLL_S: Final = 0.1
SHOW_PERIOD_S: Final = 0.5


def run(args: argparse.Namespace) -> int:
    """Run the verb; return the exit code.

    Raises NoTelemetry if nothing arrives, and RecordingError if a file cannot be written.
    """
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
    first = _receive_first(samples, files, timeout_s, is_stopped)
    # With several fingers, messages of the first tick may have been missed: all recordings start at the next tick.
    start = first.tick + (len(files) > 1)
    sample: Sample | None = first
    with ExitStack() as stack:
        writers = {
            name: stack.enter_context(PoseWriter(open_poses_file(path), duration_s)) for name, path in files.items()
        }
        all_stats = [writer.stats for writer in writers.values()]
        received_s = time.monotonic()
        shown_s = received_s - SHOW_PERIOD_S
        show = stack.enter_context(show_counter())
        while not all(stats.end_reason for stats in all_stats):
            now = time.monotonic()
            if sample is None:
                if now - received_s > timeout_s:
                    set_end_reason(all_stats, f"no data for {timeout_s:g} s")
            else:
                received_s = now
                _dispatch(sample, writers, start)
            if is_stopped():
                set_end_reason(all_stats, "stopped")
            if show is not None and now - shown_s > SHOW_PERIOD_S:
                shown_s = now
                show(f"{all_stats[0].poses} poses, {sum(stats.lost for stats in all_stats)} lost; Ctrl-C stops")
            if not all(stats.end_reason for stats in all_stats):
                sample = samples.receive(POLL_S)
    for name, writer in writers.items():
        if writer.stats.poses < 2:
            files[name].unlink(missing_ok=True)
            raise RecordingError(
                f"{files[name]}: {writer.stats.poses} pose(s) arrived ({writer.stats.end_reason}), "
                "a recording has at least 2"
            )
    return {name: writer.stats for name, writer in writers.items()}


def _dispatch(sample: Sample, writers: Mapping[str, PoseWriter], start: int) -> None:
    finger = find_finger(sample.topic)
    for name, writer in writers.items():
        is_before_start = finger is not None and writer.stats.first_tick < 0 and sample.tick < start
        if finger in (name, None) and not is_before_start and not writer.stats.end_reason:
            writer.take(sample)


def set_end_reason(all_stats: Sequence[RecordingStats], reason: str) -> None:
    for stats in all_stats:
        stats.end_reason = stats.end_reason or reason


def _receive_first(
    samples: Subscription, files: Mapping[str, Path], timeout_s: float, is_stopped: Callable[[], bool]
) -> Sample:
    until = time.monotonic() + timeout_s
    while time.monotonic() < until and not is_stopped():
        sample = samples.receive(POLL_S)
        finger = None if sample is None else find_finger(sample.topic)
        if sample is None or finger is None:
            continue
        if (finger == "") != ("" in files):
            expected = f"several fingers, such as {finger}: --poses {finger}=FILE" if finger else "one: --poses FILE"
            raise ConfigError(f"--poses of {', '.join(files) or 'one finger'}: the server has {expected}")
        if finger in files:
            return sample
    raise NoTelemetry(explain_no_telemetry(samples.endpoint, timeout_s))


class PoseWriter(Closeable):
    """Assigns a time to each pose and writes it to the file.

    The time of a row is an integer number of loop periods: the periods in the `dt` of each tick, and one for each lost
    tick. A replay at the same rate therefore plays one pose per tick. Rounded wall-clock times would not guarantee
    that. Leaving the context completes the file.
    """

    def __init__(self, file: PosesFile, duration_s: float | None) -> None:
        self.stats = RecordingStats()
        self._file = file
        self._duration_s = duration_s
        self._period = 0.0
        self._periods, self._written_tick = 0, -1
        self._buffer: list[tuple[int, Sample]] = []  # (ticks since the previous sample, sample)

    def take(self, sample: Sample) -> None:
        """Process a message of the wire, in the order of arrival; set `stats.end_reason` at the end."""
        stats = self.stats
        if sample.topic == EVENT:
            if (sample["kind"], sample["name"]) == ("lifecycle", "stopped"):
                stats.end_reason = "the server stopped"
            return
        if find_finger(sample.topic) is None:
            return
        if sample.tick <= stats.last_tick:
            stats.end_reason = "the server started again"
            return
        step = 0 if stats.last_tick < 0 else sample.tick - stats.last_tick
        if not DT_MIN_S <= sample.dt <= DT_MAX_S:
            raise ProtocolError(
                f"tick {sample.tick} has dt = {sample.dt:g} s: outside the range of a loop "
                f"({DT_MIN_S:g} to {DT_MAX_S:g}): check that this program sent it"
            )
        if sample.lost:
            stats.lost += sample.lost
            stats.gap_count += 1
            stats.worst = max(stats.worst, (stats.last_tick, sample.lost), key=lambda gap: gap[1])
        if stats.first_tick < 0:
            stats.first_tick = sample.tick
        stats.last_tick, stats.every = sample.tick, sample.every
        self._buffer.append((step, sample))
        if self._period or len(self._buffer) >= BUFFERED_POSES:
            self.flush()

    def close(self) -> None:
        try:
            self.flush()
        finally:
            self._file.close()

    def flush(self) -> None:
        if not self._period and self._buffer:
            self._period = min(sample.dt for _, sample in self._buffer)
        for step, sample in self._buffer:
            self._write(step, sample)
        self._buffer.clear()

    def _write(self, step: int, sample: Sample) -> None:
        stats = self.stats
        if step:
            self._periods += step - 1 + max(1, round(sample.dt / self._period))
        t = self._periods / find_rate(self._period)
        if self._duration_s is not None and t > self._duration_s - self._period / 2:
            stats.end_reason = f"{self._duration_s:g} s are over"
            stats.last_tick = self._written_tick
            return
        if not all(map(math.isfinite, (*sample.probe.position, *sample.probe.orientation))):
            stats.unusable += 1
            return
        stats.seconds, self._written_tick = t, sample.tick
        stats.poses += 1
        self._file.add(t, sample)
