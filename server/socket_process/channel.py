"""Channel between the daemon and its publisher: messages over a socket pair, with bounded queues and without waiting.

A message consists of its length, its kind, the length of its key, the key, and the body.
"""

from __future__ import annotations

import socket
import struct
import threading
from collections import deque
from collections.abc import Iterator
from typing import Final, NamedTuple

from softfinger.server.socket_process.channel_messages import ANSWER_MAX, Kind

_HEAD: Final = struct.Struct("<IBH")
_LONGEST: Final = ANSWER_MAX + 1024
WAITING_MAX: Final = 4 * ANSWER_MAX
"""Largest number of bytes queued for the other side; further messages are dropped."""
_READ_BYTES: Final = 65536


class Message(NamedTuple):
    """Message; `key` is its topic or its client."""

    kind: int
    key: bytes
    body: bytes


class Channel:
    """One end of the channel. `send` may be called from any thread, all other methods from one thread only."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._end, self._lock = end, threading.Lock()
        self._queue: deque[memoryview] = deque()
        self._queued_bytes = 0
        self._received = bytearray()
        self.ended = False
        """The other side has exited or sent an invalid message."""

    def fileno(self) -> int:
        return self._end.fileno()

    @property
    def has_queued(self) -> bool:
        """True if messages are queued for the other side."""
        return bool(self._queue)

    def send(self, kind: Kind, key: bytes = b"", body: bytes = b"") -> bool:
        """Send a message now, or when there is room; if the queue is full, drop it and return False."""
        head = _HEAD.pack(len(key) + len(body), kind, len(key))
        with self._lock:
            if self._queued_bytes + len(body) > WAITING_MAX or len(body) > ANSWER_MAX or self.ended:
                return False
            self._queued_bytes += len(head) + len(key) + len(body)
            self._queue.append(memoryview(head + key + body))
            self._flush()
        return True

    def flush(self) -> None:
        with self._lock:
            self._flush()

    def _flush(self) -> None:
        while self._queue and not self.ended:
            first = self._queue.popleft()
            try:
                sent_bytes = self._end.send(first)
            except BlockingIOError:
                sent_bytes = 0
            except OSError:
                self.ended = True
                return
            self._queued_bytes -= sent_bytes
            if sent_bytes < len(first):
                self._queue.appendleft(first[sent_bytes:])
                return

    def receive(self) -> Iterator[Message]:
        """Yield the messages received, including messages that an earlier caller did not consume."""
        yield from self._iter_messages()
        while not self.ended:
            try:
                data = self._end.recv(_READ_BYTES)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            self.ended = not data
            self._received += data
            yield from self._iter_messages()
            if len(data) < _READ_BYTES:
                return

    def _iter_messages(self) -> Iterator[Message]:
        while len(self._received) >= _HEAD.size:
            size, kind, of_key = _HEAD.unpack_from(self._received)
            if size > _LONGEST or of_key > size:
                self.ended = True
                return
            end = _HEAD.size + size
            if len(self._received) < end:
                return
            key = bytes(self._received[_HEAD.size : _HEAD.size + of_key])
            body = bytes(self._received[_HEAD.size + of_key : end])
            del self._received[:end]
            yield Message(kind, key, body)

    def close(self) -> None:
        with self._lock:
            self.ended = True
            self._end.close()
