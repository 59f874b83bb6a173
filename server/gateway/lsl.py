"""Telemetry as streams of Lab Streaming Layer: a channel for every number of a record, stamped with the tick's time.

LSL finds and opens streams without any key, from every machine of the network.
"""

from __future__ import annotations

import time
from typing import Any, Final

from softfinger.config.errors import ConfigError
from softfinger.proxy.record import FIELDS, RECORD_SIZE, columns
from softfinger.server.wire.client import Sample, record_of
from softfinger.server.wire.protocol import ProtocolError, decode, finger_of

NAME: Final = "softfinger"
"""Of a single finger's stream; of several fingers each has this, a hyphen and its name."""
TYPE: Final = "Haptics"


class Outlets:
    """Takes messages, and opens a finger's stream with its first tick. Raises ConfigError where pylsl is missing."""

    def __init__(self, source: str) -> None:
        try:
            import pylsl
        except (ImportError, RuntimeError) as error:  # RuntimeError: there is no liblsl
            raise ConfigError(f"--lsl needs pylsl and liblsl: {error}: pip install 'softfinger[lsl]'") from error
        self._lsl: Any = pylsl
        self._source = source
        self._outlets: dict[str, Any] = {}
        self._to_local_s = pylsl.local_clock() - time.time()
        """From the epoch to LSL's clock. The clock of this machine may be slewed meanwhile, not set."""
        self.samples = 0

    @property
    def names(self) -> list[str]:
        """Of the streams."""
        return [stream_name(finger) for finger in self._outlets]

    def send(self, topic: bytes, body: bytes) -> None:
        """A message; those that are no tick are none of a stream's."""
        finger = finger_of(topic.decode("ascii", "replace"))
        if finger is None:
            return
        try:
            message = decode(topic, body)
        except ProtocolError:
            return
        if finger not in self._outlets:
            self._outlets[finger] = self._lsl.StreamOutlet(self._info(finger))
        self._outlets[finger].push_sample(
            record_of(Sample(topic.decode(), message)), message.timestamp + self._to_local_s
        )
        self.samples += 1

    def _info(self, finger: str) -> Any:
        name = stream_name(finger)
        # Irregular: every sample says when it was, and none is where ticks were missed.
        info = self._lsl.StreamInfo(
            name, TYPE, RECORD_SIZE, self._lsl.IRREGULAR_RATE, "double64", f"{name} {self._source}"
        )
        channels = info.desc().append_child("channels")
        units = [field.unit for field in FIELDS for _ in range(field.size)]
        for label, unit in zip(columns(), units, strict=True):
            channels.append_child("channel").append_child_value("label", label).append_child_value("unit", unit)
        return info


def stream_name(finger: str) -> str:
    """What the stream of a finger is called; the single one has no name."""
    return f"{NAME}-{finger}" if finger else NAME
