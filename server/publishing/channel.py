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

from softfinger.server.publishing.setup import ANSWER_MAX, Kind

_HEAD: Final = struct.Struct("<IBH")
_LONGEST: Final = ANSWER_MAX + 1024
WAITING_MAX: Final = 4 * ANSWER_MAX
"""Largest number of bytes queued for the other side; further messages are dropped."""
_READ_BYTES: Final = 65536


class Said(NamedTuple):
    """Message; `key` is its topic or its client."""

    kind: int
    key: bytes
    body: bytes


class Channel:
    """One end of the channel. `say` may be called from any thread, all other methods from one thread only."""

    def __init__(self, end: socket.socket) -> None:
        end.setblocking(False)
        self._end, self._lock = end, threading.Lock()
        self._waiting: deque[memoryview] = deque()
        self._size = 0
        self._heard = bytearray()
        self.ended = False
        """The other side has exited or sent an invalid message."""

    def fileno(self) -> int:
        return self._end.fileno()

    @property
    def waits(self) -> bool:
        """Whether messages are queued for the other side."""
        return bool(self._waiting)

    def say(self, kind: Kind, key: bytes = b"", body: bytes = b"") -> bool:
        """Send a message now, or when there is room; if the queue is full, drop it and return False."""
        head = _HEAD.pack(len(key) + len(body), kind, len(key))
        with self._lock:
            if self._size + len(body) > WAITING_MAX or len(body) > ANSWER_MAX or self.ended:
                return False
            self._size += len(head) + len(key) + len(body)
            self._waiting.append(memoryview(head + key + body))
            self._flush()
        return True

    def flush(self) -> None:
        """Send queued messages, as far as there is room."""
        with self._lock:
            self._flush()

    def _flush(self) -> None:
        while self._waiting and not self.ended:
            first = self._waiting.popleft()
            try:
                sent = self._end.send(first)
            except BlockingIOError:
                sent = 0
            except OSError:
                self.ended = True
                return
            self._size -= sent
            if sent < len(first):
                self._waiting.appendleft(first[sent:])
                return

    def hear(self) -> Iterator[Said]:
        """Yield the messages received, including messages that an earlier caller did not consume."""
        yield from self._messages()
        while not self.ended:
            try:
                data = self._end.recv(_READ_BYTES)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            self.ended = not data
            self._heard += data
            yield from self._messages()
            if len(data) < _READ_BYTES:
                return

    def _messages(self) -> Iterator[Said]:
        while len(self._heard) >= _HEAD.size:
            size, kind, of_key = _HEAD.unpack_from(self._heard)
            if size > _LONGEST or of_key > size:
                self.ended = True
                return
            end = _HEAD.size + size
            if len(self._heard) < end:
                return
            key = bytes(self._heard[_HEAD.size : _HEAD.size + of_key])
            body = bytes(self._heard[_HEAD.size + of_key : end])
            del self._heard[:end]
            yield Said(kind, key, body)

    def close(self) -> None:
        with self._lock:
            self.ended = True
            self._end.close()
