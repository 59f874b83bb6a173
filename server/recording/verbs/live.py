"""`record FILE.mcap`: record every tick and event of a running daemon as one of its telemetry clients."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

import msgspec
import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import HapticError, RecordingError
from softfinger.config.files import open_recording
from softfinger.server.gateway.addresses import Addresses
from softfinger.server.keys import ClientKeys
from softfinger.server.progress import counter
from softfinger.server.recording.recorder import Recorded, Recorder
from softfinger.server.wire.client import NoTelemetry, Sample, Subscription, no_telemetry_text, record_of, subscribe
from softfinger.server.wire.control import Control
from softfinger.server.wire.protocol import CONTACT, EVENT, FINGERS, WORLD, finger_of

log: Final = logging.getLogger(__name__)

BATCH_S: Final = 0.02
POLL_S: Final = 0.02
DESCRIBE_S: Final = 2.0
SHOW_EVERY_S: Final = 0.5
DISK_S: Final = 10.0
"""Time limit for the last writes to the disk."""
_NOT_KEPT: Final = ("wire", "commands", "endpoints")
"""Keys of the daemon's description that are not recorded: they describe messages of the wire."""


class Live(NamedTuple):
    """Source and end of a recording.

    at          endpoints of telemetry and commands
    keys        of this client, if the daemon requires keys
    duration_s  of ticks to record; None: until the server stops
    timeout_s   silence that ends the recording
    asked       returns true if the user requested the end
    """

    at: Addresses
    keys: ClientKeys | None
    duration_s: float | None
    timeout_s: float
    asked: Callable[[], bool]


def record_live(live: Live, path: Path) -> str:
    """Record into a new file until the first of several causes ends the recording; return a report in one line.

    Raises
    ------
    NoTelemetry
        If nothing arrives.
    RecordingError
        If the file exists or cannot be written.
    """
    with subscribed(live) as wire:
        early, fingers, about = begin(wire, live)
        try:
            file = open_recording(path)
        except FileExistsError as error:
            raise RecordingError(f"{path}: is there already: a recording takes the place of no file") from error
        except OSError as error:
            raise RecordingError(f"{path}: cannot be written: {error.strerror or error}") from error
        recorder = Recorder(file, fingers, about, lambda said, _: log.warning(said))
        taking = Taking(recorder, fingers)
        try:
            ended = go_on(wire, live, early, taking)
        finally:
            recorder.note("lost", taking.lost)
            recorded = recorder.stop(DISK_S)
    return _told(path, taking, recorded, ended)


def _told(path: Path, taking: Taking, recorded: Recorded, ended: str) -> str:
    if recorded.error:
        raise RecordingError(f"{path}: cannot be written: {recorded.error}; it holds {recorded.ticks} ticks")
    lost = f"{taking.lost} did not arrive" if taking.lost else "no tick lost"
    slow = f", {recorded.dropped} left out since the disk was too slow" if recorded.dropped else ""
    unsaid = "" if recorded.whole else f"; the disk has not taken the last of it within {DISK_S:g} s"
    ticks = f"{recorded.ticks} ticks, {taking.first} to {taking.last}"
    return f"{path}: {ticks}, {recorded.bytes / 1e6:.1f} MB, {lost}{slow}; {ended}{unsaid}"


class Taker(Protocol):
    """Receiver of ticks and events."""

    def take(self, records: NDArray[np.float64], finger: int) -> None:
        """Receive records (n, RECORD_SIZE) of the finger with this index."""

    def event(self, event: Mapping[str, Any]) -> None:
        """Receive an event, a map as on the wire."""

    def world(self, world: Mapping[str, Any]) -> None:
        """Receive a message of the topic `world`, a map as on the wire."""

    @property
    def failed(self) -> bool:
        """Return whether the receiver stopped because of an error."""


class Taking:
    """Passes messages to a taker, ticks in batches."""

    def __init__(self, taker: Taker, fingers: list[str]) -> None:
        self._taker, self._places = taker, {finger: place for place, finger in enumerate(fingers)}
        self._rows: dict[int, list[list[float]]] = {place: [] for place in self._places.values()}
        self._due_s = time.monotonic() + BATCH_S
        self.first = self.last = -1
        self.seconds = 0.0
        self.lost = 0
        self.ended = ""

    def take(self, sample: Sample) -> None:
        """Process the next message; set `ended` if the server stopped or restarted."""
        finger = finger_of(sample.topic)
        if sample.topic == EVENT:
            self._taker.event(sample.data)
            if (sample["kind"], sample["name"]) == ("lifecycle", "stopped"):
                self.ended = "the server stopped"
        elif sample.topic == WORLD:
            self._taker.world(msgspec.to_builtins(sample.data))
        elif finger in self._places:
            if sample.tick < self.last:
                self.ended = "the server started again"
                return
            if self.first < 0:
                self.first = sample.tick
            if self._places[finger] == 0:
                self.seconds += sample.dt * (1 + sample.lost)
            self.last = sample.tick
            self.lost += sample.lost
            self._rows[self._places[finger]].append(record_of(sample))
        if time.monotonic() > self._due_s:
            self.hand_on()

    def hand_on(self) -> None:
        """Pass the collected ticks to the taker."""
        self._due_s = time.monotonic() + BATCH_S
        for place, rows in self._rows.items():
            if rows:
                self._taker.take(np.array(rows), place)
                rows.clear()

    @property
    def failed(self) -> bool:
        """Return whether the taker stopped because of an error."""
        failed: bool = self._taker.failed
        return failed


def go_on(wire: Subscription, live: Live, early: list[Sample], taking: Taking) -> str:
    """Process the early messages and all that arrive until the end; return the cause of the end."""
    try:
        for sample in early:
            taking.take(sample)
        return _until_the_end(wire, live, taking)
    finally:
        taking.hand_on()


def _until_the_end(wire: Subscription, live: Live, taking: Taking) -> str:
    heard = shown = time.monotonic()
    with counter() as show:
        while not taking.ended:
            sample = wire.receive(POLL_S)
            now = time.monotonic()
            if sample is None:
                taking.hand_on()
                if now - heard > live.timeout_s:
                    return f"nothing arrived for {live.timeout_s:g} s"
            else:
                heard = now
                if _over(sample, live, taking):
                    return f"{live.duration_s:g} s are over"
                taking.take(sample)
            if live.asked():
                return "stopped"
            if taking.failed:
                return "the file takes no more"
            if show is not None and now - shown > SHOW_EVERY_S:
                shown = now
                show(f"tick {taking.last}, {taking.lost} lost; Ctrl-C stops")
    return taking.ended


def _over(sample: Sample, live: Live, taking: Taking) -> bool:
    if live.duration_s is None or finger_of(sample.topic) is None:
        return False
    # Half a tick early, because the sum of time steps has rounding errors.
    return bool(taking.seconds > live.duration_s - 0.5 * sample.dt and sample.tick > taking.last)


def subscribed(live: Live) -> Subscription:
    """Subscribe to all recorded topics."""
    return subscribe(live.at.telemetry, (CONTACT, FINGERS, EVENT, WORLD), keys=live.keys)


def begin(wire: Subscription, live: Live) -> tuple[list[Sample], list[str], dict[str, Any]]:
    """Return the first messages, the names of the fingers, and the daemon's description, empty if it sends none.

    Raises
    ------
    NoTelemetry
        If nothing arrives.
    """
    early = _early(wire, live)
    fingers = list(dict.fromkeys(finger for sample in early if (finger := finger_of(sample.topic)) is not None))
    return early, fingers, _description(live) | {"every": early[-1]["every"]}


def _early(wire: Subscription, live: Live) -> list[Sample]:
    """Return the messages of at least one complete tick, which names all fingers, with the events before it."""
    samples: list[Sample] = []
    ticks: dict[str, int] = {}
    until = time.monotonic() + live.timeout_s
    while time.monotonic() < until and not live.asked():
        sample = wire.receive(POLL_S)
        if sample is None:
            continue
        samples.append(sample)
        if finger_of(sample.topic) is not None:
            ticks[sample.topic] = ticks.get(sample.topic, 0) + 1
            # Messages of one tick arrive together: before the third message of one finger, each finger has had one.
            if ticks[sample.topic] == 3:
                return samples
    raise NoTelemetry(no_telemetry_text(live.at.telemetry, live.timeout_s))


def _description(live: Live) -> dict[str, Any]:
    """Return the daemon's description; empty if it accepts no commands."""
    try:
        with Control(live.at.command_endpoint(), DESCRIBE_S, keys=live.keys) as control:
            return {key: value for key, value in control.describe().items() if key not in _NOT_KEPT}
    except HapticError as error:
        log.warning("it is not known which rig and scene this is: %s", error)
        return {}
