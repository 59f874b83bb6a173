"""`record FILE.mcap`: record every tick and event of a running daemon as one of its telemetry clients."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import HapticError, RecordingError
from softfinger.config.files import open_recording
from softfinger.server.gateway.addresses import Addresses
from softfinger.server.keys import ClientKeys
from softfinger.server.progress import show_counter
from softfinger.server.recording.reader import translate_errors
from softfinger.server.recording.recorder import Recorder
from softfinger.server.wire.client import NoTelemetry, Sample, Subscription, explain_no_telemetry, record_of, subscribe
from softfinger.server.wire.control import Control
from softfinger.server.wire.protocol import CONTACT, EVENT, FINGERS, SCENE_TOPICS, find_finger

log: Final = logging.getLogger(__name__)

BATCH_S: Final = 0.02
POLL_S: Final = 0.02
DESCRIBE_TIMEOUT_S: Final = 2.0
SHOW_PERIOD_S: Final = 0.5
DISK_TIMEOUT_S: Final = 10.0
"""Time limit for the last writes to the disk."""
_UNRECORDED_KEYS: Final = ("wire", "commands", "endpoints")
"""Keys of the daemon's description that are not recorded: they describe messages of the wire."""


class RecordingJob(NamedTuple):
    """Source and end of a recording.

    addresses          endpoints of telemetry and commands
    keys               of this client, if the daemon requires keys
    duration_s         of ticks to record; None: until the server stops
    timeout_s          silence that ends the recording
    is_stop_requested  returns true if the user requested the end
    """

    addresses: Addresses
    keys: ClientKeys | None
    duration_s: float | None
    timeout_s: float
    is_stop_requested: Callable[[], bool]


def record_live(job: RecordingJob, path: Path) -> str:
    """Record into a new file until the first of several causes ends the recording; return a report in one line.

    Raises
    ------
    NoTelemetry
        If nothing arrives.
    RecordingError
        If the file exists or cannot be written.
    """
    with subscribe_all(job) as wire:
        first_samples, fingers, about = receive_first(wire, job)
        with translate_errors(path):
            file = open_recording(path)
        recorder = Recorder(file, fingers, about, lambda text, _: log.warning(text))
        batcher = TickBatcher(recorder, fingers)
        try:
            end_reason = record_until_end(wire, job, first_samples, batcher, lambda: recorder.recorded.error)
        finally:
            recorder.note("lost", batcher.lost)
            recorded = recorder.stop(DISK_TIMEOUT_S)
    if recorded.error:
        contents = f"it has {recorded.ticks} ticks" if path.exists() else "it was empty and is removed"
        raise RecordingError(f"{path}: cannot be written: {recorded.error}; {contents}")
    loss_text = f"{batcher.lost} did not arrive" if batcher.lost else "no tick lost"
    slow = f", {recorded.dropped} not recorded because the disk was too slow" if recorded.dropped else ""
    unfinished = "" if recorded.whole else f"; the last ticks were not written to the disk within {DISK_TIMEOUT_S:g} s"
    ticks = f"{recorded.ticks} ticks, {batcher.first} to {batcher.last}"
    return f"{path}: {ticks}, {recorded.bytes / 1e6:.1f} MB, {loss_text}{slow}; {end_reason}{unfinished}"


class TickReceiver(Protocol):
    def ticks(self, records: NDArray[np.float64], finger: str) -> None:
        """Receive records (n, RECORD_SIZE) of a finger."""

    def event(self, event: Mapping[str, Any]) -> None:
        """Receive an event, a map as on the wire."""

    def message(self, topic: str, message: Mapping[str, Any]) -> None:
        """Receive a message of one of SCENE_TOPICS, a map as on the wire."""


class TickBatcher:
    """Passes messages to a receiver, ticks in batches."""

    def __init__(self, receiver: TickReceiver, fingers: list[str]) -> None:
        self._receiver, self._first_finger = receiver, fingers[0]
        self._rows: dict[str, list[list[float]]] = {finger: [] for finger in fingers}
        self._due_s = time.monotonic() + BATCH_S
        self.first = self.last = self._timed_tick = -1
        self.seconds = 0.0
        self.lost = 0
        self.end_reason = ""

    def take(self, sample: Sample) -> None:
        """Process the next message; set `end_reason` if the server stopped or restarted."""
        finger = find_finger(sample.topic)
        if sample.topic == EVENT:
            self._receiver.event(sample.data)
            if (sample["kind"], sample["name"]) == ("lifecycle", "stopped"):
                self.end_reason = "the server stopped"
        elif sample.topic in SCENE_TOPICS:
            self._receiver.message(sample.topic, msgspec.to_builtins(sample.data))
        elif finger is not None and finger in self._rows:
            if sample.tick < self.last:
                self.end_reason = "the server started again"
                return
            if self.first < 0:
                self.first = sample.tick
            if finger == self._first_finger:
                self.seconds += sample.dt * (sample.tick - self._timed_tick if self._timed_tick >= 0 else 1)
                self._timed_tick = sample.tick
            self.last = sample.tick
            self.lost += sample.lost
            self._rows[finger].append(record_of(sample))
        if time.monotonic() > self._due_s:
            self.flush()

    def flush(self) -> None:
        self._due_s = time.monotonic() + BATCH_S
        for finger, rows in self._rows.items():
            if rows:
                self._receiver.ticks(np.array(rows), finger)
                rows.clear()


def record_until_end(
    wire: Subscription,
    job: RecordingJob,
    first_samples: list[Sample],
    batcher: TickBatcher,
    has_failed: Callable[[], object] = lambda: False,
) -> str:
    """Process the first messages and all that arrive until the end; return the cause of the end."""
    received_s = shown_s = time.monotonic()
    with ExitStack() as stack:
        stack.callback(batcher.flush)
        show = stack.enter_context(show_counter())
        waiting = iter(first_samples)
        while not batcher.end_reason:
            sample = next(waiting, None) or wire.receive(POLL_S)
            now = time.monotonic()
            if sample is None:
                batcher.flush()
                if now - received_s > job.timeout_s:
                    return f"no data for {job.timeout_s:g} s"
            else:
                received_s = now
                if _is_over(sample, job, batcher):
                    return f"{job.duration_s:g} s are over"
                batcher.take(sample)
            if job.is_stop_requested():
                return "stopped"
            if has_failed():
                return "the file accepts no more data"
            if show is not None and now - shown_s > SHOW_PERIOD_S:
                shown_s = now
                show(f"tick {batcher.last}, {batcher.lost} lost; Ctrl-C stops")
    return batcher.end_reason


def _is_over(sample: Sample, job: RecordingJob, batcher: TickBatcher) -> bool:
    if job.duration_s is None or find_finger(sample.topic) is None:
        return False
    # Half a tick early, because the sum of time steps has rounding errors.
    return bool(batcher.seconds > job.duration_s - 0.5 * sample.dt and sample.tick > batcher.last)


def subscribe_all(job: RecordingJob) -> Subscription:
    return subscribe(job.addresses.telemetry, (CONTACT, FINGERS, EVENT, *SCENE_TOPICS), keys=job.keys)


def receive_first(wire: Subscription, job: RecordingJob) -> tuple[list[Sample], list[str], dict[str, Any]]:
    """Return the first messages, the names of the fingers, and the daemon's description, empty if it sends none.

    Raises
    ------
    NoTelemetry
        If nothing arrives.
    """
    first_samples, fingers = receive_full_tick(wire, job)
    return first_samples, fingers, _request_description(job) | {"every": first_samples[-1]["every"]}


def receive_full_tick(wire: Subscription, job: RecordingJob) -> tuple[list[Sample], list[str]]:
    """Return the messages of at least one complete tick, with the events before it, and the names of the fingers."""
    samples: list[Sample] = []
    ticks: dict[str, int] = {}
    until = time.monotonic() + job.timeout_s
    while time.monotonic() < until and not job.is_stop_requested():
        sample = wire.receive(POLL_S)
        if sample is None:
            continue
        samples.append(sample)
        if find_finger(sample.topic) is not None:
            ticks[sample.topic] = ticks.get(sample.topic, 0) + 1
            # Messages of one tick arrive together: before the third message of one finger, each finger has had one.
            if ticks[sample.topic] == 3:
                return samples, [find_finger(topic) or "" for topic in ticks]
    raise NoTelemetry(explain_no_telemetry(job.addresses.telemetry, job.timeout_s))


def _request_description(job: RecordingJob) -> dict[str, Any]:
    """Return the daemon's description; empty if it accepts no commands."""
    try:
        with Control(job.addresses.command_endpoint(), DESCRIBE_TIMEOUT_S, keys=job.keys) as control:
            return {key: value for key, value in control.describe().items() if key not in _UNRECORDED_KEYS}
    except HapticError as error:
        log.warning("rig and scene are unknown: %s", error)
        return {}
