"""The publisher: records in, ZeroMQ messages out, never waiting for a subscriber."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import ConfigError
from softfinger.config.schema import commands_beside
from softfinger.proxy.record import RECORD_SIZE, columns
from softfinger.server.closing import Closing
from softfinger.server.wire.endpoint import listen
from softfinger.server.wire.events import RecordEvents
from softfinger.server.wire.fanout import Fanout
from softfinger.server.wire.health import Health, together
from softfinger.server.wire.native.backlog import CHUNK_BYTES, TICK, broadcast, octets
from softfinger.server.wire.native.memory import LAYOUT
from softfinger.server.wire.native.sender import Sender, Source
from softfinger.server.wire.native.templates import Shown
from softfinger.server.wire.protocol import (
    EVENT,
    HEALTH,
    RETAINED,
    SCHEMA,
    SCHEMA_TOPIC,
    STATE,
    contact_topic,
    encode,
    finger_of,
    wire_schema,
)
from softfinger.server.wire.zmtp import message

log: Final = logging.getLogger(__name__)

Records = NDArray[np.float64]

BACKLOG: Final = 40960
"""Messages kept for subscribers that stall: 5 s at 8 kHz, 41 s at 1 kHz, some 60 MB, once for all of them."""

KEY: Final = "[telemetry] endpoint"

LINGER_S: Final = 0.2
"""How long closing waits for the last messages (the event that says why) to leave."""


class Publisher(Closing):
    """ZeroMQ publisher bound to `endpoint`; sends one tick in `every`, of several `fingers` each under its name.
    It says where `commands` are taken: nowhere if empty, beside the endpoint if None.

    Ticks come from a servo (`attach`), and a thread without Python sends them; what follows from them is told by
    whoever feeds `observe` with the records of `tap`. `observe` and `publish` belong to one thread; `event` may be
    called from any, but not from a signal handler. After `close` they do nothing. Raises AddressInUse if another
    process holds the endpoint, ConfigError if the endpoint cannot or may not be bound.
    """

    def __init__(
        self,
        endpoint: str,
        every: int = 1,
        *,
        guard_names: Sequence[str] = (),
        fingers: Sequence[str] = ("",),
        commands: str | None = None,
        backlog: int = BACKLOG,
    ) -> None:
        if every < 1:
            raise ConfigError(f"[telemetry] every = {every} is below 1: 1 publishes each tick, 10 one in ten")
        self._lock = threading.Lock()
        self._topics = (*map(contact_topic, fingers), STATE, EVENT, HEALTH, SCHEMA_TOPIC)
        self._events = [RecordEvents(guard_names, finger, place == 0) for place, finger in enumerate(fingers)]
        self._health = [Health() for _ in fingers]
        self._closed = False
        listener, self._files, self.endpoint = listen(endpoint, KEY)
        retained = sum(1 << i for i, topic in enumerate(self._topics) if topic in RETAINED or finger_of(topic))
        self._sender = Sender(fingers, every, len(self._topics), retained, backlog)
        self.tap: Final = self._sender.tap
        """The records that were sent, for one thread of this process."""
        content = {
            "schema": SCHEMA,
            "timestamp": time.time(),
            "topics": self._topics,
            "commands": commands_beside(self.endpoint) if commands is None else commands,
            "messages": wire_schema()["messages"],
        }
        greeting = message(SCHEMA_TOPIC.encode(), encode(content))
        topics = [topic.encode() for topic in self._topics]
        self.fanout = Fanout(listener, topics, {SCHEMA_TOPIC.encode(): greeting}, self._sender.backlog)

    def ring(self) -> dict[str, Any]:
        """Where programs of this user find every tick as memory, for `describe`."""
        fingers = len(self._events)
        return {"name": self._sender.memory, "layout": LAYOUT, "columns": columns(), "records_in_a_row": fingers}

    def attach(self, source: Source) -> None:
        """Send what a servo does from here on, until it has ended. Once."""
        self._sender.attach(source)

    def show(self, shown: Shown) -> None:
        """What `state` is to say beside the tick."""
        with self._lock:
            if not self._closed:
                self._sender.show(shown)

    def publish(self, records: Records, drops: int = 0) -> None:
        """Send records that come from no servo, shape (n, fingers x RECORD_SIZE), and what follows from them."""
        with self._lock:
            if not self._closed:
                self._sender.send(records)
        self.observe(records, drops)

    def observe(self, records: Records, drops: int = 0) -> None:
        """Send the events and the health that follow from a batch of records, shape (n, fingers x RECORD_SIZE).

        `drops` is how many records did not get here since the servo started.
        """
        with self._lock:
            if self._closed or not len(records):
                return
            fingers = records.reshape(len(records), -1, RECORD_SIZE).swapaxes(0, 1)
            events = [event for seen, each in zip(self._events, fingers, strict=True) for event in seen.observe(each)]
            for event in sorted(events, key=_tick_of):
                self._send(EVENT, event)
            healths = [sums.add(each, drops) for sums, each in zip(self._health, fingers, strict=True)]
            for health in map(together, zip(*healths, strict=True)):
                health["subscribers"] = self.fanout.subscribers
                health["lost"] = self.fanout.lost
                health["refused"] = self.fanout.refused
                self._send(HEALTH, health)
            if self.fanout.failed or self.tap.failed:
                raise RuntimeError("the thread that sends, or that takes subscribers in, has ended")

    def event(self, kind: str, name: str, **fields: Any) -> None:
        """Send an event at once; `fields` are further keys, of types msgpack knows."""
        with self._lock:
            if self._closed:
                return
            tick = int(self._sender.backlog.words[TICK])
            self._send(
                EVENT, fields | {"schema": SCHEMA, "timestamp": time.time(), "tick": tick, "kind": kind, "name": name}
            )

    def close(self) -> None:
        """Send what is under way, for at most LINGER_S, and free the endpoint. Any number of times."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            self.fanout.close(LINGER_S)
            self._sender.close()
            self._files.close()

    def _send(self, topic: str, content: dict[str, Any]) -> None:
        wire = message(topic.encode(), encode(content))
        if len(wire) > CHUNK_BYTES:
            log.warning("telemetry: a message of %d bytes to %s is longer than any client takes", len(wire), topic)
            return
        broadcast(self._sender.backlog, self._topics.index(topic), octets(wire))


def _tick_of(event: dict[str, Any]) -> int:
    tick: int = event["tick"]
    return tick
