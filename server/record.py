"""`record --poses`: the poses of a running daemon, with any device, as a file that `replay` plays.

A client of the wire and nothing more. Rows go to the file as they come, so what was recorded before a kill is there.
"""

from __future__ import annotations

import argparse
import logging
import math
import signal
import sys
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import IO, Any, Final

import numpy as np

from softfinger.config.errors import ConfigError, RecordingError
from softfinger.drivers.poses import POSE_COLUMNS
from softfinger.server.client import DEFAULT_ENDPOINT, NoTelemetry, Sample, Subscription, record_of, silence, subscribe
from softfinger.server.protocol import CONTACT, EVENT
from softfinger.server.results import McapResults

log: Final = logging.getLogger(__name__)

ENDINGS: Final = (".csv", ".mcap")
HELD: Final = 200
"""Poses held back at the start, to find the period of the loop in; a tick that was late has more than one in its dt."""
POLL_S: Final = 0.1
SHOW_EVERY_S: Final = 0.5
_LINE: Final = ",".join(["%.17g"] * len(POSE_COLUMNS)) + "\n"  # 17 digits bring every float64 back


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the verb's arguments."""
    parser.description = "Record the poses of a running server as a file that `run --recording` and `simulate` take."
    parser.add_argument(
        "--poses", type=Path, required=True, metavar="FILE", help=".csv: poses alone; .mcap: every value of every tick"
    )
    parser.add_argument("--endpoint", default=DEFAULT_ENDPOINT, help="telemetry endpoint (default: %(default)s)")
    parser.add_argument(
        "--duration", type=float, metavar="S", help="stop after S seconds (default: at the server's end)"
    )
    parser.add_argument(
        "--timeout", type=float, metavar="S", default=3.0, help="end when nothing arrives for S seconds (default: 3)"
    )


def run(args: argparse.Namespace) -> int:
    """Run the verb. Raises NoTelemetry if nothing arrives, RecordingError for a file that cannot be written."""
    for name in ("duration", "timeout"):
        value = getattr(args, name)
        if value is not None and not 0.0 < value < math.inf:
            raise ConfigError(f"--{name} = {value} is not a time: give seconds above 0")
    with subscribe(args.endpoint, (CONTACT, EVENT)) as samples, stopping() as stopped:
        kept = record(samples, args.poses, args.duration, args.timeout, stopped)
    log.info("%s: %s", args.poses, kept)
    if kept.lost:
        log.warning("%s", kept.gaps())
    return 0


class Stop:
    """Whether a signal has asked for the end."""

    asked = False


@contextmanager
def stopping() -> Iterator[Stop]:
    """SIGINT and SIGTERM end the recording in order; the handlers are put back afterwards."""
    stop = Stop()

    def ask(*_: object) -> None:
        stop.asked = True

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@dataclass
class Kept:
    """What a recording holds.

    first_tick, last_tick  of the server, -1 before there is one
    poses                  rows written
    lost, gap_count        published ticks between them that did not arrive, in so many gaps
    worst                  (tick before it, ticks lost) of the longest gap
    unusable               poses left out because they are none: not finite
    every                  one tick in so many is published
    seconds                time from first to last row
    ended                  why the recording ended
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
    ended: str = ""

    def __str__(self) -> str:
        thin = f", one in {self.every}" if self.every > 1 else ""
        whole = "" if self.lost else ", no tick lost"
        bad = f", {self.unusable} left out that are no pose" if self.unusable else ""
        ticks = f"ticks {self.first_tick} to {self.last_tick}{thin}"
        return f"{self.poses} poses of {ticks}, {self.seconds:.3f} s{whole}{bad}; {self.ended}"

    def gaps(self) -> str:
        """What to tell a user whose recording has holes."""
        return (
            f"{self.lost} ticks in {self.gap_count} gaps did not arrive, the longest {self.worst[1]} after tick "
            f"{self.worst[0]}: a replay goes smoothly over each; record on a machine with less to do, or with "
            "[telemetry] every above 1"
        )


class PosesFile(ABC):
    """A file that rows of t (s), position (m), orientation go to, with the message they are from."""

    @abstractmethod
    def add(self, t: float, sample: Sample) -> None:
        """Add one pose."""

    @abstractmethod
    def close(self) -> None:
        """Finish the file."""


class CsvPoses(PosesFile):
    """`t,x,y,z,qw,qx,qy,qz`; every number comes back to the bit."""

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._file: IO[str] = path.open("w", encoding="ascii", newline="\n", buffering=1 << 16)
            self._file.write(",".join(POSE_COLUMNS) + "\n")
        except OSError as error:
            raise self._failed(error) from error

    def add(self, t: float, sample: Sample) -> None:
        try:
            self._file.write(_LINE % (t, *sample.probe.position, *sample.probe.orientation))
        except OSError as error:
            raise self._failed(error) from error

    def close(self) -> None:
        try:
            self._file.close()
        except OSError as error:
            raise self._failed(error) from error

    def _failed(self, error: OSError) -> RecordingError:
        return RecordingError(f"{self._path}: cannot be written: {error.strerror or error}")


class McapPoses(PosesFile):
    """Whole records on topic `contact`, in blocks; their time is the wall clock's."""

    BLOCK: Final = 256

    def __init__(self, path: Path) -> None:
        self._results = McapResults(path)
        self._rows: list[list[float]] = []

    def add(self, t: float, sample: Sample) -> None:
        self._rows.append(record_of(sample))
        if len(self._rows) == self.BLOCK:
            self._flush()

    def close(self) -> None:
        self._flush()
        self._results.close()

    def _flush(self) -> None:
        if self._rows:
            self._results.append(np.array(self._rows))
            self._rows.clear()


def poses_file(path: Path) -> PosesFile:
    """Open the file for the kind its ending names; ConfigError for another ending."""
    kinds: dict[str, Any] = {".csv": CsvPoses, ".mcap": McapPoses}
    if path.suffix.lower() not in kinds:
        raise ConfigError(f"--poses {path}: poses are recorded as {' or '.join(ENDINGS)}, by the file's ending")
    made: PosesFile = kinds[path.suffix.lower()](path)
    return made


def record(
    samples: Subscription, path: Path, duration_s: float | None = None, timeout_s: float = 3.0, stop: Stop | None = None
) -> Kept:
    """Write what arrives until `duration_s` of ticks, the server's end, or a stop.

    Raises NoTelemetry when nothing arrives within `timeout_s` at the start; silence later ends the recording.
    """
    first = _first(samples, timeout_s, stop)
    file = poses_file(path)
    clock = Clock(file, duration_s)
    kept = clock.kept
    shown = heard = time.monotonic()
    sample: Sample | None = first
    try:
        while not kept.ended:
            now = time.monotonic()
            if sample is None:
                if now - heard > timeout_s:
                    kept.ended = f"nothing arrived for {timeout_s:g} s"
            else:
                heard = now
                clock.take(sample)
            if stop is not None and stop.asked:
                kept.ended = kept.ended or "stopped"
            if sys.stderr.isatty() and now - shown > SHOW_EVERY_S:
                shown = now
                print(
                    f"\r\x1b[K{kept.poses} poses, {kept.lost} lost; Ctrl-C stops", end="", file=sys.stderr, flush=True
                )
            if not kept.ended:
                sample = samples.receive(POLL_S)
    finally:
        if sys.stderr.isatty():
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
        clock.flush()
        file.close()
    if kept.poses < 2:
        raise RecordingError(f"{path}: {kept.poses} pose(s) arrived ({kept.ended}), a recording has at least 2")
    return kept


def _first(samples: Subscription, timeout_s: float, stop: Stop | None) -> Sample:
    until = time.monotonic() + timeout_s
    while time.monotonic() < until and not (stop is not None and stop.asked):
        sample = samples.receive(POLL_S)
        if sample is not None and sample.topic == CONTACT:
            return sample
    raise NoTelemetry(silence(samples.endpoint, timeout_s))


@cache
def rate_of(period_s: float) -> float:
    """The roundest rate (Hz) whose period is this to the nanosecond, as the loop's is: the one that its rig says."""
    nanoseconds = round(period_s * 1e9)
    for digits in range(7):
        rate = round(1e9 / nanoseconds, digits)
        if round(1e9 / rate) == nanoseconds:
            return rate
    return 1e9 / nanoseconds


class Clock:
    """Gives each pose its time and hands it to the file.

    The time of a row is a whole number of the loop's periods: those in each tick's `dt`, and one for each tick that
    did not arrive. So a replay at the same rate plays each pose in a tick of its own, which times of the wall clock,
    rounded as they are, would not do.
    """

    def __init__(self, file: PosesFile, duration_s: float | None) -> None:
        self.kept = Kept()
        self._file = file
        self._duration_s = duration_s
        self._period = 0.0
        self._periods = 0
        self._held: list[tuple[int, Sample]] = []  # with the ticks lost before each

    def take(self, sample: Sample) -> None:
        """A message of the wire, in its order; sets `kept.ended` at the end."""
        kept = self.kept
        if sample.topic == EVENT:
            if (sample["kind"], sample["name"]) == ("lifecycle", "stopped"):
                kept.ended = "the server stopped"
            return
        if sample.topic != CONTACT:
            return
        if sample.tick <= kept.last_tick:
            kept.ended = "the server started again"
            return
        step = 0 if kept.last_tick < 0 else sample.tick - kept.last_tick
        if sample.lost:
            kept.lost += sample.lost
            kept.gap_count += 1
            kept.worst = max(kept.worst, (kept.last_tick, sample.lost), key=lambda gap: gap[1])
        if kept.first_tick < 0:
            kept.first_tick = sample.tick
        kept.last_tick, kept.every = sample.tick, sample.every
        self._held.append((step, sample))
        if self._period or len(self._held) >= HELD:
            self.flush()

    def flush(self) -> None:
        """Write what is held back."""
        if not self._period and self._held:
            self._period = min(sample.dt for _, sample in self._held)
        for step, sample in self._held:
            self._write(step, sample)
        self._held.clear()

    def _write(self, step: int, sample: Sample) -> None:
        kept = self.kept
        if step:
            self._periods += step - 1 + max(1, round(sample.dt / self._period))
        t = self._periods / rate_of(self._period)
        if self._duration_s is not None and t > self._duration_s - self._period / 2:
            kept.ended = f"{self._duration_s:g} s are over"
            return
        if not all(map(math.isfinite, (*sample.probe.position, *sample.probe.orientation))):
            kept.unusable += 1
            return
        kept.seconds = t
        kept.poses += 1
        self._file.add(t, sample)
