"""ZMTP 3.0 as a server speaks it (ZeroMQ RFC 23): frames out; handshake, subscriptions and requests in, with bounds.

libzmq's own PUB socket is not used: it takes in any number of subscriptions, keeps some 40 bytes for each of their
bytes, and does so within the call that sends, so that a single peer fills the memory and keeps the sender busy. Nor
is its ROUTER socket: that keeps the frames of a message without end, 1.3 GB from one peer in 3 s.
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections import deque
from typing import Final

MORE: Final = 1
LONG: Final = 2
COMMAND: Final = 4

GREETING_BYTES: Final = 64
GREETING: Final = b"\xff" + struct.pack(">Q", 1) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32)
"""Signature, version 3.0, mechanism NULL, and nothing else."""

FRAME_MAX: Final = 512
"""Longest frame of a peer, bytes. A READY with an identity of the greatest length has 300, our topics have 7."""

TOPICS_MAX: Final = 32
"""Most subscriptions of one peer: there are three topics, and a proxy adds prefixes of them."""

REQUEST_MAX: Final = 262144
"""Longest frame of a peer that asks, bytes: a scene of 256 objects has some 130 KB."""

_SUBSCRIBERS: Final = (b"SUB", b"XSUB")
_CLIENTS: Final = (b"DEALER", b"REQ")


class Refused(Exception):
    """A peer that is to be disconnected, and why."""


def frame(flags: int, body: bytes) -> bytes:
    """One frame with its header."""
    if len(body) < 256:
        return bytes((flags, len(body))) + body
    return struct.pack(">BQ", flags | LONG, len(body)) + body


def message(topic: bytes, body: bytes) -> bytes:
    """The two frames of a published message."""
    return frame(MORE, topic) + frame(0, body)


def command(name: bytes, data: bytes = b"") -> bytes:
    """A command's frame."""
    return frame(COMMAND, bytes((len(name),)) + name + data)


def _property(name: bytes, value: bytes) -> bytes:
    return bytes((len(name),)) + name + struct.pack(">I", len(value)) + value


class Stream(ABC):
    """What one peer has sent: its handshake, and then messages. Holds less than `frame_max` bytes between calls.

    kind       of our socket
    kinds      of the peer's that go with it; `wanted` says so in words
    frame_max  longest frame, bytes; `what` says what they are
    """

    kind: bytes
    kinds: tuple[bytes, ...]
    wanted: str
    frame_max: int
    what: str

    def __init__(self) -> None:
        self._buffer = bytearray()
        self._greeted = False
        self.ready = False
        """The handshake is done: messages may be sent."""
        self.frames = 0
        """Frames taken so far."""

    def feed(self, data: bytes) -> bytes:
        """Take bytes as they come; returns what to answer. Raises Refused."""
        self._buffer += data
        answer = b""
        if not self._greeted:
            if not self._greeting():
                return b""
            answer = command(b"READY", _property(b"Socket-Type", self.kind))
        while (taken := self._frame()) is not None:
            self.frames += 1
            flags, body = taken
            if flags & COMMAND:
                answer += self._command(body)
            elif self.ready:
                self._message(flags, body)
            else:
                raise Refused("does not finish the handshake")
        return answer

    def _greeting(self) -> bool:
        head = self._buffer
        if head[:1] != b"\xff" or (len(head) > 9 and not head[9] & 1):
            raise Refused("does not speak ZMTP")
        if len(head) > 10 and head[10] < 3:
            raise Refused("speaks ZMTP 2 or older: use ZeroMQ 4.0 or newer")
        if len(head) < GREETING_BYTES:
            return False
        if head[12:32].rstrip(b"\0") != b"NULL":
            raise Refused("wants a security mechanism, and there is none")
        del head[:GREETING_BYTES]
        self._greeted = True
        return True

    def _frame(self) -> tuple[int, bytes] | None:
        """Next whole frame: flags and body."""
        head = self._buffer
        if not head:
            return None
        flags = head[0]
        if flags & ~(MORE | LONG | COMMAND):
            raise Refused("does not speak ZMTP")
        start = 9 if flags & LONG else 2
        if len(head) < start:
            return None
        size = int.from_bytes(head[1:start], "big")
        if size > self.frame_max:
            raise Refused(f"sends a frame of {size} bytes: {self.what} has at most {self.frame_max}")
        if len(head) < start + size:
            return None
        body = bytes(head[start : start + size])
        del head[: start + size]
        return flags, body

    def _command(self, body: bytes) -> bytes:
        if not body or len(body) <= body[0]:
            raise Refused("does not speak ZMTP")
        name, data = body[1 : 1 + body[0]], body[1 + body[0] :]
        if not self.ready:
            self._handshake(name, data)
        elif name == b"PING":
            return command(b"PONG", data[2:])  # behind two bytes of time-out
        else:
            self._named(name, data)
        return b""

    def _handshake(self, name: bytes, data: bytes) -> None:
        if name != b"READY":
            raise Refused("does not finish the handshake")
        kind = b""
        while data:
            key, rest = data[1 : 1 + data[0]], data[1 + data[0] :]
            size = int.from_bytes(rest[:4], "big")
            if len(rest) < 4 + size or len(rest) < 4:
                raise Refused("does not speak ZMTP")
            value, data = rest[4 : 4 + size], rest[4 + size :]
            if key.lower() == b"socket-type":
                kind = value
        if kind not in self.kinds:
            raise Refused(f"is a {kind.decode('ascii', 'replace')[:16] or 'socket of no type'}: {self.wanted}")
        self.ready = True

    @abstractmethod
    def _message(self, flags: int, body: bytes) -> None:
        """Take a frame of a message."""

    def _named(self, name: bytes, data: bytes) -> None:  # noqa: B027 - no command but a PING needs to be taken
        """Take a command's frame after the handshake."""


class Incoming(Stream):
    """What a subscriber has sent: its subscriptions."""

    kind, kinds, wanted = b"PUB", _SUBSCRIBERS, "connect a SUB socket"
    frame_max, what = FRAME_MAX, "a subscription"

    def __init__(self) -> None:
        super().__init__()
        self.topics: set[bytes] = set()

    def _named(self, name: bytes, data: bytes) -> None:
        if name == b"SUBSCRIBE":  # of ZMTP 3.1
            self._subscribe(data)
        elif name == b"CANCEL":
            self.topics.discard(data)

    def _message(self, flags: int, body: bytes) -> None:
        if body[:1] == b"\1":
            self._subscribe(body[1:])
        elif body[:1] == b"\0":
            self.topics.discard(body[1:])
        # Anything else is a message to a publisher, which has no use for it.

    def _subscribe(self, topic: bytes) -> None:
        self.topics.add(topic)
        if len(self.topics) > TOPICS_MAX:
            raise Refused(f"has more than {TOPICS_MAX} subscriptions")


class Requests(Stream):
    """What a client has sent: messages of two frames, an empty one and the request."""

    kind, kinds, wanted = b"ROUTER", _CLIENTS, "connect a DEALER or REQ socket"
    frame_max, what = REQUEST_MAX, "a request"

    def __init__(self) -> None:
        super().__init__()
        self.waiting: deque[bytes | None] = deque()
        """Requests to be answered, oldest first; None: a message of other frames."""
        self._parts = 0
        self._empty = False

    def _message(self, flags: int, body: bytes) -> None:
        self._parts += 1
        if self._parts == 1:
            self._empty = not body
        if not flags & MORE:
            self.waiting.append(body if self._empty and self._parts == 2 else None)
            self._parts = 0
