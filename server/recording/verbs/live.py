"""`record FILE.mcap`: every tick and event of a running daemon, from the wire. A client and nothing more."""

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
from softfinger.server.wire.client import NoTelemetry, Sample, Subscription, record_of, silence, subscribe
from softfinger.server.wire.control import Control
from softfinger.server.wire.protocol import CONTACT, EVENT, FINGERS, WORLD, finger_of

log: Final = logging.getLogger(__name__)

BATCH_S: Final = 0.02
POLL_S: Final = 0.02
DESCRIBE_S: Final = 2.0
SHOW_EVERY_S: Final = 0.5
DISK_S: Final = 10.0
"""How long the end waits for the disk."""
_NOT_KEPT: Final = ("wire", "commands", "endpoints")
"""Of the daemon's description: they say how messages look that are not in the file."""


class Live(NamedTuple):
    """What to record, and until when.

    at          where it is published, and where the daemon describes itself
    duration_s  of ticks; None until the server's end
    keys        of a client, where the daemon wants some
    timeout_s   of silence, that ends it
    asked       whether somebody asks for the end
    """

    at: Addresses
    keys: ClientKeys | None
    duration_s: float | None
    timeout_s: float
    asked: Callable[[], bool]


def record_live(live: Live, path: Path) -> str:
    """Record into a new file until the end of one of many kinds; returns what to tell of it.

    Raises NoTelemetry when nothing arrives, RecordingError for a file that is there already or cannot be written.
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
    """Whom ticks and events are handed to."""

    def take(self, records: NDArray[np.float64], finger: int) -> None:
        """Records (n, RECORD_SIZE) of a finger, by its place."""

    def event(self, event: Mapping[str, Any]) -> None:
        """An event's map, as the wire has it."""

    def world(self, world: Mapping[str, Any]) -> None:
        """A message of `world`, a map as the wire has it."""

    @property
    def failed(self) -> bool:
        """Whether it takes no more."""


class Taking:
    """Hands messages to a taker, ticks some at a time."""

    def __init__(self, taker: Taker, fingers: list[str]) -> None:
        self._taker, self._places = taker, {finger: place for place, finger in enumerate(fingers)}
        self._rows: dict[int, list[list[float]]] = {place: [] for place in self._places.values()}
        self._due_s = time.monotonic() + BATCH_S
        self.first = self.last = -1
        self.seconds = 0.0
        self.lost = 0
        self.ended = ""

    def take(self, sample: Sample) -> None:
        """A message, in its order; sets `ended` at the server's end."""
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
        """Give the taker what came."""
        self._due_s = time.monotonic() + BATCH_S
        for place, rows in self._rows.items():
            if rows:
                self._taker.take(np.array(rows), place)
                rows.clear()

    @property
    def failed(self) -> bool:
        """Whether the taker takes no more."""
        failed: bool = self._taker.failed
        return failed


def go_on(wire: Subscription, live: Live, early: list[Sample], taking: Taking) -> str:
    """Take what came early and what arrives until the end; returns which it was. All that came is handed on."""
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
    # Half a tick early: a sum of time steps is rounded.
    return bool(taking.seconds > live.duration_s - 0.5 * sample.dt and sample.tick > taking.last)


def subscribed(live: Live) -> Subscription:
    """A client of all that is taken."""
    return subscribe(live.at.telemetry, (CONTACT, FINGERS, EVENT, WORLD), keys=live.keys)


def begin(wire: Subscription, live: Live) -> tuple[list[Sample], list[str], dict[str, Any]]:
    """The first messages, the names of the fingers, and what the daemon says of itself, empty if it does not.

    Raises NoTelemetry when nothing arrives.
    """
    early = _early(wire, live)
    fingers = list(dict.fromkeys(finger for sample in early if (finger := finger_of(sample.topic)) is not None))
    return early, fingers, _description(live) | {"every": early[-1]["every"]}


def _early(wire: Subscription, live: Live) -> list[Sample]:
    """The messages of one whole tick at the least, so that every finger is among them, and events before."""
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
            # Those of a tick come one after the other: with the third of one, all others have come.
            if ticks[sample.topic] == 3:
                return samples
    raise NoTelemetry(silence(live.at.telemetry, live.timeout_s))


def _description(live: Live) -> dict[str, Any]:
    """What the daemon says of itself; empty where it takes no commands."""
    try:
        with Control(live.at.commanded(), DESCRIBE_S, keys=live.keys) as control:
            return {key: value for key, value in control.describe().items() if key not in _NOT_KEPT}
    except HapticError as error:
        log.warning("it is not known which rig and scene this is: %s", error)
        return {}
