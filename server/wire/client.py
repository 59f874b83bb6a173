"""Telemetry client: an iterator over messages, and a NumPy window of the latest ticks.

    with subscribe() as samples:
        for sample in samples:
            print(sample.tick, sample.contact.mode, sample["force"], sample.lost)

Any ZeroMQ and msgpack client can read the stream (docs/protocol.md); this one also validates each message and counts
the ticks that did not arrive.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import repeat
from operator import attrgetter
from typing import Any, Final

import msgspec
import numpy as np
import zmq
from numpy.typing import NDArray

from softfinger.config.arguments import check_text, describe_refusal
from softfinger.config.errors import ConfigError, HapticError
from softfinger.config.words import format_value
from softfinger.drivers.closeable import Closeable
from softfinger.proxy.record import FIELDS, PATCHES, RECORD_SIZE
from softfinger.proxy.records import Records
from softfinger.server.keys import ClientKeys, check_keys
from softfinger.server.wire import DEFAULT_ENDPOINT
from softfinger.server.wire.client_requests import ask_for_keys, connect, to_milliseconds
from softfinger.server.wire.protocol import (
    CONTACT,
    FINGERS,
    SCENE_TOPICS,
    TOPICS,
    ProtocolError,
    decode,
    find_finger,
    name_contact_topic,
)

_RECEIVE_BACKLOG: Final = 40960  # same as the publisher's: a short pause of the client loses nothing
_FRAME_MAX: Final = 1 << 20

SAMPLES_MAX: Final = 1_000_000
"""Largest window: 17 minutes at 1 kHz, 2 GB."""

_IN_LISTS: Final = [i for i, field in enumerate(FIELDS) if field.name.startswith("contacts")]
_VALUES_BEFORE: Final = attrgetter(*(field.name for field in FIELDS[: _IN_LISTS[0]]))
_VALUES_AFTER: Final = attrgetter(*(field.name for field in FIELDS[_IN_LISTS[-1] + 1 :]))
_PATCH_FIELDS: Final = [field for field in FIELDS if field.name.startswith("contacts0.")]
_PATCH_VALUES: Final = attrgetter(*(field.name.partition(".")[2] for field in _PATCH_FIELDS))
_NO_PATCH: Final = [-1.0, *repeat(0.0, sum(field.size for field in _PATCH_FIELDS) - 1)]
"""Values in a record for a patch that a message omits."""


class NoTelemetry(HapticError):
    """No telemetry arrived from an endpoint."""

    exit_code = 9


@dataclass(frozen=True, slots=True)
class Sample:
    """Message with keys as attributes (`sample.contact.mode`) and items (`sample["contact.mode"]`).

    Attributes
    ----------
    topic
        Topic of the message.
    data
        Decoded message.
    lost
        Number of published ticks missing before this one; 0 for other topics.
    """

    topic: str
    data: Any
    lost: int = 0

    def __getitem__(self, key: str) -> Any:
        value = self.data
        for part in key.split("."):
            try:
                value = value[part] if isinstance(value, dict) else getattr(value, part)
            except AttributeError:
                raise KeyError(key) from None
        return value

    def __getattr__(self, name: str) -> Any:
        if name == "data" or name.startswith("_"):  # not a key; and `data` itself is missing during a copy
            raise AttributeError(name)
        try:
            return self[name]
        except KeyError:
            raise AttributeError(f"a {self.topic} message has no key {name!r}") from None

    def __dir__(self) -> list[str]:
        keys = self.data if isinstance(self.data, dict) else getattr(self.data, "__struct_fields__", ())
        return sorted({*object.__dir__(self), *keys})

    def as_map(self) -> dict[str, Any]:
        """Convert the message to plain dicts; vectors of a contact message become tuples."""
        plain: dict[str, Any] = msgspec.to_builtins(self.data)
        return plain


class Subscription(Closeable):
    """Iterator over the messages of an endpoint, and a context manager; `subscribe` makes one.

    Iteration raises NoTelemetry after the timeout, and ProtocolError for a message that does not follow the protocol.

    Parameters
    ----------
    endpoint
        Telemetry endpoint of the daemon.
    topics
        One topic or several.
    timeout_s
        Longest wait for a message, s; None waits without limit.
    keys
        Keys of the client, if the server requires them.

    Raises
    ------
    ConfigError
        If a topic is unknown or the endpoint is invalid.
    """

    def __init__(
        self,
        endpoint: str = DEFAULT_ENDPOINT,
        topics: Sequence[str] = (CONTACT,),
        timeout_s: float | None = None,
        keys: ClientKeys | None = None,
    ) -> None:
        topics = [topics] if isinstance(topics, str) or not isinstance(topics, Iterable) else [*topics]
        unknown = [topic for topic in topics if not _is_topic(topic)]
        if unknown or not topics:
            raise ConfigError(
                f"topics = {format_value(topics)}: choose from {', '.join((*TOPICS, *SCENE_TOPICS))}, {FINGERS}NAME "
                f"for one of several fingers, or {FINGERS} for all of them"
            )
        self.endpoint = check_text(endpoint, "endpoint", DEFAULT_ENDPOINT)
        self.topics: Final = tuple(topics)
        self.timeout_s = timeout_s
        self._keys = check_keys(keys)
        self._connect()

    def _connect(self) -> None:
        self._process = os.getpid()
        self._ticks: dict[str, int] = {}
        self._wait_ms = -1
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context.instance()
        self._socket = context.socket(zmq.SUB)
        self._socket.rcvhwm = _RECEIVE_BACKLOG
        for topic in self.topics:
            self._socket.subscribe(topic)
        connect(self._socket, self.endpoint, self._keys, _FRAME_MAX)

    def __repr__(self) -> str:
        return f"<Subscription to {', '.join(self.topics)} on {self.endpoint}>"

    def receive(self, timeout_s: float | None = None) -> Sample | None:
        """Wait for the next message.

        Parameters
        ----------
        timeout_s
            Longest wait, s; None waits without limit.

        Returns
        -------
        Sample or None
            None after the timeout.

        Raises
        ------
        ProtocolError
            If a message does not follow the protocol; the next call continues after it.
        """
        if self._process != os.getpid():  # a socket does not survive a fork: libzmq would wait forever
            self._connect()
        wait_ms = to_milliseconds(timeout_s)
        if wait_ms != self._wait_ms:  # timeout of the socket: polling first would take half as long again
            self._socket.rcvtimeo = self._wait_ms = wait_ms
        try:
            frames = self._socket.recv_multipart()
        except zmq.Again:
            return None
        if len(frames) != 2:
            raise ProtocolError(
                f"message of {len(frames)} frames from {self.endpoint}, expected 2 (topic and map): "
                "check that no other program publishes here"
            )
        topic, body = frames
        message = decode(topic, body)
        name = topic.decode()
        if find_finger(name) is None:
            return Sample(name, message)
        return Sample(name, message, self._count_lost(name, message.tick, message.every))

    def _count_lost(self, topic: str, tick: int, every: int) -> int:
        before, self._ticks[topic] = self._ticks.get(topic), tick
        if before is None or tick <= before:  # the first tick, or the server was restarted
            return 0
        return (tick - before - 1) // max(every, 1)

    def __iter__(self) -> Iterator[Sample]:
        return self

    def __next__(self) -> Sample:
        if self._socket.closed:
            raise StopIteration
        sample = self.receive(self.timeout_s)
        if sample is None:
            raise NoTelemetry(explain_no_telemetry(self.endpoint, self.timeout_s or 0.0))
        return sample

    def close(self) -> None:
        """Disconnect; may be called repeatedly."""
        self._socket.close()

    def __del__(self) -> None:
        # A loop that is left by break cannot close it elsewhere.
        if hasattr(self, "_socket"):
            self.close()


subscribe = Subscription


def explain_no_telemetry(endpoint: str, waited_s: float) -> str:
    """Return the message for a user if nothing arrived."""
    return (
        f"no telemetry from {endpoint} within {waited_s:g} s: is the server running (softfinger run), "
        f"has it compiled its scene, and is this its [telemetry] endpoint?{ask_for_keys(endpoint)}"
    )


def record_of(sample: Sample) -> list[float]:
    """Convert a contact message to the record (RECORD_SIZE,) that was published."""
    message = sample.data
    row = _flatten(_VALUES_BEFORE(message))
    for patch in message.contacts:
        row += _flatten(_PATCH_VALUES(patch))
    row += _NO_PATCH * (PATCHES - len(message.contacts))
    return row + _flatten(_VALUES_AFTER(message))


def _flatten(values: tuple[Any, ...]) -> list[float]:
    row: list[float] = []
    for value in values:
        if isinstance(value, tuple):
            row.extend(value)
        else:
            row.append(value)
    return row


def _is_topic(topic: object) -> bool:
    return isinstance(topic, str) and (topic in (*TOPICS, *SCENE_TOPICS) or topic.startswith(FINGERS))


class Window(Closeable):
    """Latest ticks of a finger as NumPy arrays, in tick order.

    `window["force"]` has shape (m, 3) and `window["tick"]` (m,), with m <= `samples`. Float fields are views that the
    next `update` may overwrite, integer fields are int64 copies.

    Parameters
    ----------
    endpoint
        Telemetry endpoint of the daemon.
    samples
        Largest number of ticks.
    finger
        Name of the finger, empty for a single one.
    keys
        Keys of the client, if the server requires them.

    Raises
    ------
    ConfigError
        If `samples` is out of range, or the endpoint is invalid.
    """

    def __init__(
        self, endpoint: str = DEFAULT_ENDPOINT, samples: int = 1000, finger: str = "", keys: ClientKeys | None = None
    ) -> None:
        if not isinstance(samples, int | np.integer) or not 1 <= samples <= SAMPLES_MAX:
            raise ConfigError(describe_refusal("samples", samples, f"an integer from 1 to {SAMPLES_MAX}"))
        self._size = samples
        # Twice the required length: rows are appended, and moved back when the end is reached, so the latest ones are
        # always one contiguous view.
        self._rows = np.empty((2 * samples, RECORD_SIZE))
        self._end = 0
        self._tick = -1
        self.lost = 0
        """Published ticks that did not arrive since the window was opened."""
        self._subscription = Subscription(
            endpoint, (name_contact_topic(check_text(finger, "finger", "thumb")),), keys=keys
        )

    def update(self, timeout_s: float | None = 0.0) -> int:
        """Read the ticks that have arrived.

        Parameters
        ----------
        timeout_s
            Longest wait for the first tick, s; None waits without limit.

        Returns
        -------
        int
            Number of ticks read.
        """
        count = 0
        wait_ms = to_milliseconds(timeout_s)
        until_s = time.monotonic() + (math.inf if wait_ms < 0 else wait_ms / 1000.0)
        while count < _RECEIVE_BACKLOG:  # a publisher faster than this loop must not block it forever
            sample = self._subscription.receive(0.0 if count else max(0.0, until_s - time.monotonic()))
            if sample is None:
                break
            if sample.data.tick <= self._tick:  # the server was restarted: the old ticks belong to another run
                self._end = 0
            self._tick = sample.data.tick
            if self._end == len(self._rows):
                self._rows[: self._size] = self._rows[self._size :]
                self._end = self._size
            self._rows[self._end] = record_of(sample)
            self._end += 1
            self.lost += sample.lost
            count += 1
        return count

    def __repr__(self) -> str:
        return f"<Window: {len(self)} of {self._size} ticks on {self._subscription.endpoint}, {self.lost} lost>"

    def _ipython_key_completions_(self) -> list[str]:
        """Return the completions that IPython and notebooks offer after `window[`."""
        return [field.name for field in FIELDS]

    def __len__(self) -> int:
        return min(self._end, self._size)

    def __getitem__(self, name: str) -> NDArray[Any]:
        values: NDArray[Any] = Records(self._rows[self._end - len(self) : self._end])[name]
        return values

    def close(self) -> None:
        """Disconnect; received ticks remain readable. May be called repeatedly."""
        self._subscription.close()
