"""The daemon's interface to its publisher: accepts records, from which a separate process sends ZeroMQ messages.

Another process receives commands, so that subscribers cannot delay them.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from operator import itemgetter
from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import ConfigError
from softfinger.config.schema import make_commands_address
from softfinger.drivers.closeable import Closeable
from softfinger.proxy.kernels.jit.compiler.progress import COMPILE_PROGRESS
from softfinger.proxy.record import RECORD_SIZE, list_columns
from softfinger.server.loop.rings import Rings
from softfinger.server.socket_process.channel_messages import Figures, Kind, ProcessSetup, StateInfo, TickParameters
from softfinger.server.wire.events import RecordEvents, make_event, read_clock_s
from softfinger.server.wire.health import HealthSummary, combine
from softfinger.server.wire.native.memory import LAYOUT
from softfinger.server.wire.native.relay import Relay
from softfinger.server.wire.native.switch import SharedSwitch
from softfinger.server.wire.process_link import SILENT_MAX_S, Send, SocketProcess
from softfinger.server.wire.protocol import (
    EVENT,
    HEALTH,
    MAX_BYTES,
    SCENE_TOPICS,
    SCHEMA,
    SCHEMA_TOPIC,
    STATE,
    STATE_HZ,
    describe_messages,
    encode,
    name_contact_topic,
)
from softfinger.server.wire.rig_endpoints import COMMANDS, TELEMETRY, Endpoints, bind_telemetry

log: Final = logging.getLogger(__name__)

Records = NDArray[np.float64]

BACKLOG: Final = 40960
"""Messages queued for a subscriber that stalls: 5 s at 8 kHz, 41 s at 1 kHz, about 60 MB."""

LINGER_S: Final = 0.2
"""Time for which closing waits for the last messages, such as the event with the reason of the end."""


class Publisher(Closeable):
    """ZeroMQ publisher on `endpoints`, which it closes, or on a new endpoint.

    It sends one tick in `every`, with a topic for each of several `fingers`. Ticks come from a servo (`attach`); a
    thread without Python passes them to the process that sends them. Events and health follow from the records of
    `tap`, which the caller passes to `observe`. `observe` and `publish` belong to one thread; `event` may be called
    from any, but not from a signal handler. After `close` they do nothing. Raises AddressInUse if another process uses
    the endpoint, ConfigError if the endpoint cannot or may not be bound.

    backlog   messages queued for a subscriber that stalls
    priority  SCHED_FIFO priority that the processes request; 0 for none
    extra     topics of the scene, whose messages `send_message` sends
    switch    force switch shared with the process of commands; it is closed with this object
    """

    def __init__(
        self,
        endpoints: Endpoints | str,
        every: int = 1,
        *,
        guard_names: Sequence[str] = (),
        fingers: Sequence[str] = ("",),
        backlog: int = BACKLOG,
        priority: int = 0,
        extra: Sequence[str] = (),
        switch: SharedSwitch | None = None,
    ) -> None:
        if every < 1:
            raise ConfigError(f"[telemetry] every = {every} is below 1: 1 publishes each tick, 10 one in ten")
        self._lock = threading.Lock()
        self.report_event: Callable[..., None] = self.event
        """Called like `event` for events of the process; replaced by a function that also records them."""
        self._topics = [*map(name_contact_topic, fingers), STATE, EVENT, HEALTH, *extra, SCHEMA_TOPIC]
        self._ticks = TickParameters(SCHEMA, every, self._topics[: len(fingers)], STATE, STATE_HZ)
        self._backlog, self._priority, self._state_info, self._health_body = backlog, priority, StateInfo(), b""
        self._events = [RecordEvents(guard_names, finger, index == 0) for index, finger in enumerate(fingers)]
        self._health = [HealthSummary() for _ in fingers]
        self._closed, self._state, self._preparing = False, "", ""
        is_standalone = isinstance(endpoints, str)
        self._endpoints: Final = bind_telemetry(endpoints) if isinstance(endpoints, str) else endpoints
        self.endpoint: Final = self._endpoints.telemetry
        announced = self._endpoints.public.get(COMMANDS, self._endpoints.commands or "")
        content = {
            "schema": SCHEMA,
            "timestamp": read_clock_s(),
            "topics": self._topics,
            "commands": make_commands_address(self.endpoint) if is_standalone else announced,
            "messages": describe_messages()["messages"],
        }
        self._greeting = encode(content)
        self._starts = 0
        with ExitStack() as undo:
            undo.callback(self._endpoints.close)
            self._switch: Final = SharedSwitch() if switch is None else switch
            undo.callback(self._switch.close)
            self._relay: Final = Relay(len(fingers))
            undo.callback(self._relay.close)
            files = [self._relay.memory.reading, self._relay.bell, self._switch.file]
            for listener in self._endpoints.listeners:
                files += [listener.fd, listener.renewals]
            self.commands: Final = self._open_commands(files)
            """Process that receives commands; None if they are off."""
            if self.commands is not None:
                undo.callback(self.commands.close, 0.0)
            self._link: Final = SocketProcess(TELEMETRY, self._setup_telemetry, files, self._report_restart)
            undo.pop_all()
        self._links: Final = [self._link] if self.commands is None else [self._link, self.commands]
        self.tap: Final = self._relay.tap
        """Records passed on by the relay, for one thread of this process."""

    def _open_commands(self, files: list[int]) -> SocketProcess | None:
        """Start the process of commands; None if they are off."""
        if not any(listener.name == COMMANDS for listener in self._endpoints.listeners):
            return None
        self._switch.require_process()
        return SocketProcess(
            COMMANDS,
            lambda send: self._send_setup(send, COMMANDS, 0),
            files,
            self._report_restart,
            self._switch.count_handled,
            self._switch.replace_process,
            SILENT_MAX_S,
        )

    def _setup_telemetry(self, send: Send) -> None:
        # The first process misses no tick; peers of an earlier process have missed the ticks since its end.
        begin = self._relay.rows if self._starts else 0
        self._starts += 1
        self._send_setup(send, TELEMETRY, begin)
        send(Kind.GREETING, SCHEMA_TOPIC.encode(), self._greeting)
        if self._health_body:
            send(Kind.GREETING, HEALTH.encode(), self._health_body)

    def _send_setup(self, send: Send, name: str, begin: int) -> None:
        setup = ProcessSetup(
            self._relay.memory.reading,
            begin,
            self._relay.bell,
            self._switch.file,
            self._backlog,
            self._priority,
            self._ticks,
            self._state_info,
            [listener for listener in self._endpoints.listeners if listener.name == name],
        )
        send(Kind.SETUP, b"", encode(setup))

    def _report_restart(self, text: str) -> None:
        self.report_event("fault", "publisher", message=text)

    def ring(self) -> dict[str, Any]:
        """Return where programs of this user find every tick in memory, for `describe`."""
        fingers = len(self._events)
        return {
            "name": self._relay.memory.name,
            "layout": LAYOUT,
            "columns": list_columns(),
            "records_in_a_row": fingers,
        }

    @property
    def native_id(self) -> int | None:
        """Native id of the thread that passes ticks on."""
        return self._relay.native_id

    @property
    def pids(self) -> dict[str, int]:
        """Ids of the processes, by the name of their endpoints: telemetry and, if there are any, commands."""
        return {link.name: link.pid for link in self._links}

    @property
    def figures(self) -> Figures:
        figures = self._link.figures
        if self.commands is None:
            return figures
        return msgspec.structs.replace(figures, refused=figures.refused + self.commands.figures.refused)

    @property
    def has_failed(self) -> bool:
        """True if a process of the endpoints cannot be started, or a thread of the publisher has failed."""
        return any(link.failed for link in self._links) or self.tap.failed

    @property
    def restarts(self) -> int:
        return sum(link.restarts for link in self._links)

    def rebind(self) -> Iterator[str]:
        """Rebind sockets with removed or replaced files; yield their endpoints (`Endpoints.rebind`)."""
        return self._endpoints.rebind()

    def attach(self, source: Rings) -> None:
        """Send the ticks of a servo from now on, until it ends. Call it once."""
        self._relay.attach(source)

    def set_state_info(self, state_info: StateInfo) -> None:
        """Set the contents of `state` that do not come from the tick."""
        with self._lock:
            self._state_info = state_info
            if not self._closed:
                self._link.send(Kind.STATE_INFO, body=encode(state_info))

    def set_preparing(self, text: str) -> None:
        """Set the progress of a scene in preparation, which `health` contains from now on.

        If it is empty, `health` contains that of a compilation in this process.
        """
        self._preparing = text

    def publish(self, records: Records, drops: int = 0) -> None:
        """Send records without a servo, shape (n, fingers x RECORD_SIZE), and the messages that follow from them."""
        with self._lock:
            if not self._closed:
                self._relay.send(records)
        self.observe(records, drops)

    def observe(self, records: Records, drops: int = 0) -> None:
        """Send the events and the health that follow from a batch of records, shape (n, fingers x RECORD_SIZE).

        drops  number of records lost since the servo started

        Raises RuntimeError if the process or the relay has failed.
        """
        with self._lock:
            if self._closed or not len(records):
                return
            fingers = records.reshape(len(records), -1, RECORD_SIZE).swapaxes(0, 1)
            events = [
                event for source, rows in zip(self._events, fingers, strict=True) for event in source.observe(rows)
            ]
            for event in sorted(events, key=itemgetter("tick")):
                self._send(EVENT, event)
            figures = self.figures
            drops += figures.missed
            healths = [sums.add(rows, drops) for sums, rows in zip(self._health, fingers, strict=True)]
            for health in map(combine, zip(*healths, strict=True)):
                health["subscribers"] = figures.subscribers
                health["lost"] = figures.lost
                health["refused"] = figures.refused
                health["restarts"] = self.restarts
                health["state"] = self._state
                health["preparing"] = self._preparing or str(COMPILE_PROGRESS)
                self._send(HEALTH, health)
            if self.has_failed:
                raise RuntimeError("a process of the endpoints, or the forwarding thread, has ended")

    def event(self, kind: str, name: str, **fields: Any) -> None:
        """Send an event with the present time; `fields` are further keys, of types that msgpack can encode."""
        self.send_event(make_event((self._relay.tick, read_clock_s()), kind, name, fields))

    def send_event(self, event: dict[str, Any]) -> None:
        """Send an event; if it is a new state of the daemon, `health` contains that state from now on."""
        if event["kind"] == "state":
            self._state = event["name"]
        with self._lock:
            if not self._closed:
                self._send(EVENT, event)

    def send_message(self, topic: str, message: dict[str, Any]) -> None:
        """Send a message of one of SCENE_TOPICS, of which a new subscriber receives the latest; from any thread."""
        with self._lock:
            if not self._closed:
                self._send(topic, message)

    def close(self) -> None:
        """Send queued messages, for at most LINGER_S, and free the endpoint; may be called repeatedly."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
        for link in self._links:
            link.close(LINGER_S)
        self._relay.close()
        self._switch.close()
        self._endpoints.close()

    def _send(self, topic: str, content: dict[str, Any]) -> None:
        body = encode(content)
        if len(body) > MAX_BYTES:
            log.warning("telemetry: a message of %d bytes to %s is longer than clients accept", len(body), topic)
            return
        if topic == HEALTH:
            self._health_body = body
        self._link.send(Kind.RETAINED if topic in (HEALTH, *SCENE_TOPICS) else Kind.MESSAGE, topic.encode(), body)
