"""Connection of the page to a daemon: one thread collects telemetry, another sends commands."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Collection, Sequence
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import HapticError
from softfinger.server.keys import ClientKeys
from softfinger.server.wire.client import record_of, subscribe
from softfinger.server.wire.control import Control
from softfinger.server.wire.protocol import CONTACT, EVENT, FINGERS, HEALTH, WORLD, find_finger

QUEUE_MAX: Final = 8192
"""Maximum of queued ticks per finger, and of queued events."""
TOPICS: Final = (CONTACT, FINGERS, EVENT, HEALTH, WORLD)
WAIT_S: Final = 0.2
"""Period at which a thread checks whether it should exit."""


class ReceivedData(NamedTuple):
    """Ticks and events since the last call, and latest state.

    ticks      records (n, RECORD_SIZE) by finger
    bodies     poses by name
    preparing  progress of what the daemon prepares
    has_lost   whether ticks were lost since the last call, and with them perhaps events
    """

    ticks: dict[str, NDArray[np.float64]]
    events: list[dict[str, Any]]
    bodies: dict[str, Any]
    preparing: str
    has_lost: bool


class TelemetryReceiver:
    """Telemetry of a running daemon. `problem` is an error of the received messages, or empty."""

    def __init__(self, endpoint: str, keys: ClientKeys | None, topics: Sequence[str] = TOPICS) -> None:
        self._samples = subscribe(endpoint, topics, keys=keys)
        self._rows: dict[str, deque[list[float]]] = {}
        self._events = deque[dict[str, Any]](maxlen=QUEUE_MAX)
        self._bodies: dict[str, Any] = {}
        self._preparing, self._has_lost = "", False
        self._closing = threading.Event()
        self.problem = ""
        self._thread = threading.Thread(target=self._receive_samples, name="ticks", daemon=True)
        self._thread.start()

    def _receive_samples(self) -> None:
        while not self._closing.is_set():
            try:
                sample = self._samples.receive(WAIT_S)
            except HapticError as error:
                self.problem = str(error)
                continue
            if sample is None:
                continue
            finger = find_finger(sample.topic)
            if sample.topic == WORLD:
                self._bodies = {body.name: (body.position, body.orientation) for body in sample.data.bodies}
            elif sample.topic == HEALTH:
                self._preparing = sample.data.preparing
            elif finger is None:
                self._events.append(sample.data)
            else:
                self._rows.setdefault(finger, deque(maxlen=QUEUE_MAX)).append(record_of(sample))
                self._has_lost |= sample.lost > 0

    def take(self) -> ReceivedData:
        ticks = {finger: np.array(rows) for finger, queue in list(self._rows.items()) if (rows := _drain(queue))}
        has_lost, self._has_lost = self._has_lost, False
        return ReceivedData(ticks, _drain(self._events), self._bodies, self._preparing, has_lost)

    def close(self) -> None:
        self._closing.set()
        self._thread.join()
        self._samples.close()


def _drain(queue: deque[Any]) -> list[Any]:
    """Remove and return all elements of a queue that another thread may be filling."""
    return [queue.popleft() for _ in range(len(queue))]


def ignore(answer: Any) -> None:
    """Ignore a result or an error."""


class QueuedCommand(NamedTuple):
    """Command, and the functions to call with its result or its error."""

    method: str
    params: dict[str, Any]
    on_result: Callable[[Any], None] = ignore
    on_error: Callable[[str], None] = ignore


class CommandQueue:
    """Command queue: a thread sends one command at a time; a new one replaces a waiting one of the same name.

    allowed_methods  None: all
    """

    def __init__(
        self,
        endpoint: str,
        keys: ClientKeys | None,
        timeout_s: float | None = None,
        allowed_methods: Collection[str] | None = None,
    ) -> None:
        self._allowed_methods = allowed_methods
        self._control = Control(endpoint, timeout_s, keys)
        self._pending: dict[str, QueuedCommand] = {}
        self._changed = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="commands", daemon=True)
        self._thread.start()

    def submit(self, name: str, request: QueuedCommand) -> None:
        if self._allowed_methods is not None and request.method not in self._allowed_methods:
            request.on_error(f"{request.method}: the --role of this page does not permit it")
            return
        with self._changed:
            self._pending[name] = request
            self._changed.notify()

    def _run(self) -> None:
        while True:
            with self._changed:
                while not self._pending and not self._closing:
                    self._changed.wait()
                if self._closing:
                    return
                request = self._pending.pop(next(iter(self._pending)))
            try:
                result = self._control.ask(request.method, request.params)
            except HapticError as error:
                request.on_error(str(error))
            else:
                request.on_result(result)

    def close(self) -> None:
        """Discard the waiting commands, and wait briefly for a pending answer."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(WAIT_S)
        if not self._thread.is_alive():
            self._control.close()
