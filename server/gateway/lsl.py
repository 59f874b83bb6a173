"""Telemetry as streams of Lab Streaming Layer: a channel for every number of a record, and events as markers.

All samples are stamped with the tick's time. LSL finds and opens streams without any key, from every machine of the
network.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Final

import msgspec

from softfinger.config.errors import ConfigError
from softfinger.proxy.record import FIELDS, RECORD_SIZE, list_columns
from softfinger.server.wire.client import Sample, record_of
from softfinger.server.wire.protocol import EVENT, STATE, ProtocolError, decode, find_finger

NAME: Final = "softfinger"
"""Name of the stream of a single finger; with several fingers, a hyphen and the finger's name are appended."""
TYPE: Final = "Haptics"
MARKERS: Final = "softfinger-events"
MARKERS_TYPE: Final = "Markers"
SAME_CLOCK_S: Final = 5.0
"""A `state` with a CLOCK_MONOTONIC this close to ours is from this machine: two machines have the same uptime only by
rare coincidence."""


class Outlets:
    """Consumer of messages that opens a finger's stream at its first tick; raises ConfigError if pylsl is missing."""

    def __init__(self, source: str) -> None:
        try:
            import pylsl
        except (ImportError, RuntimeError) as error:  # RuntimeError: liblsl is missing
            raise ConfigError(f"--lsl needs pylsl and liblsl: {error}: pip install 'softfinger[lsl]'") from error
        self._lsl: Any = pylsl
        self._source = source
        self._outlets: dict[str, Any] = {}
        self._to_local_s = _measure_offset(pylsl.local_clock, time.time)
        """Offset from the epoch of telemetry to LSL's clock."""
        self._lsl_s = _measure_offset(pylsl.local_clock, time.monotonic)
        """Offset from CLOCK_MONOTONIC to LSL's clock: 0 on Linux, except for the time between the calls."""
        self._newest = (-1, 0.0)
        self._markers = pylsl.StreamOutlet(self._create_stream_info(MARKERS, MARKERS_TYPE, 1, "string"))
        self.samples = self.markers = 0

    @property
    def names(self) -> list[str]:
        """Names of the streams of ticks."""
        return [stream_name(finger) for finger in self._outlets]

    def send(self, topic: bytes, body: bytes) -> None:
        """Send a message to its stream; ignores messages that are neither tick nor event."""
        name = topic.decode("ascii", "replace")
        finger = find_finger(name)
        if finger is None and name not in (EVENT, STATE):
            return
        try:
            message = decode(topic, body)
        except ProtocolError:
            return
        if name == STATE:
            self._set_clock(message.sequence, message.timestamp)
        elif finger is None:
            self._markers.push_sample([format_marker(message)], message["timestamp"] + self._to_local_s)
            self.markers += 1
        else:
            self._newest = (message.tick, message.timestamp)
            if finger not in self._outlets:
                self._outlets[finger] = self._lsl.StreamOutlet(self._describe_stream(finger))
            self._outlets[finger].push_sample(record_of(Sample(name, message)), message.timestamp + self._to_local_s)
            self.samples += 1

    def _set_clock(self, tick: int, monotonic_s: float) -> None:
        """Set the offset from a tick with a known time on both clocks.

        The daemon's epoch is fixed relative to CLOCK_MONOTONIC when it starts. This machine's clock may have been set
        since then, and is therefore used only for a daemon on another machine.
        """
        if tick == self._newest[0] and abs(monotonic_s - time.monotonic()) < SAME_CLOCK_S:
            self._to_local_s = monotonic_s - self._newest[1] + self._lsl_s

    def _describe_stream(self, finger: str) -> Any:
        info = self._create_stream_info(stream_name(finger), TYPE, RECORD_SIZE, "double64")
        channels = info.desc().append_child("channels")
        units = [field.unit for field in FIELDS for _ in range(field.size)]
        for label, unit in zip(list_columns(), units, strict=True):
            channels.append_child("channel").append_child_value("label", label).append_child_value("unit", unit)
        return info

    def _create_stream_info(self, name: str, kind: str, channels: int, form: str) -> Any:
        # Irregular: every sample has its time, and missed ticks have no sample.
        rate = self._lsl.IRREGULAR_RATE
        return self._lsl.StreamInfo(name, kind, channels, rate, form, f"{name} {self._source}")


def _measure_offset(local_clock: Callable[[], float], clock: Callable[[], float]) -> float:
    """Return the offset (s) from a clock to LSL's: the shortest of five measurements, since a call may be delayed."""
    readings = [(clock(), local_clock(), clock()) for _ in range(5)]
    before, local, after = min(readings, key=lambda reading: reading[2] - reading[0])
    return local - (before + after) / 2


def format_marker(event: dict[str, Any]) -> str:
    """Return an event as the text of a marker, JSON: `tick`, `kind`, `name` and its other keys."""
    content = {key: value for key, value in event.items() if key not in ("schema", "timestamp")}
    return msgspec.json.encode(content).decode()


def stream_name(finger: str) -> str:
    """Return the name of a finger's stream; a single finger has no name."""
    return f"{NAME}-{finger}" if finger else NAME
