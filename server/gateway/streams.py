"""Telemetry through the gateway: every message of a server is received once and passed to all consumers."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import msgspec
import zmq

from softfinger.server.keys import ClientKeys
from softfinger.server.wire.protocol import CONTACT, FINGERS, MAX_BYTES

QUEUE: Final = 8192
"""Messages queued for a slow subscriber, 8 s at 1 kHz; beyond that, libzmq drops new messages for it."""
MESSAGES_PER_TURN: Final = 256

_TICKING: Final = (CONTACT.encode(), FINGERS.encode())


class _Tick(msgspec.Struct):
    """Part of a message that is needed to count missing ticks."""

    tick: int
    every: int


class Stream:
    """Subscription to a server, with counts of its messages.

    Subscribers' topics are not passed on: for the server, the gateway is a single subscriber.
    """

    def __init__(self, context: zmq.Context[Any], endpoint: str, keys: ClientKeys | None) -> None:
        self.socket: zmq.Socket[bytes] = context.socket(zmq.SUB)
        self.socket.linger, self.socket.rcvhwm, self.socket.maxmsgsize = 0, QUEUE, MAX_BYTES
        self.socket.ipv6 = "[" in endpoint
        if keys is not None:
            keys.apply_to(self.socket)
        self.socket.subscribe(b"")
        self.socket.connect(endpoint)
        self.consumers: list[Callable[[bytes, bytes], None]] = []
        """Functions called with each message."""
        self.messages = self.size = self.lost = 0
        """Number and bytes of messages so far, and number of missing ticks."""
        self._decode = msgspec.msgpack.Decoder(_Tick).decode
        self._ticks: dict[bytes, int] = {}

    def take(self) -> None:
        for _ in range(MESSAGES_PER_TURN):
            try:
                frames = self.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            if len(frames) != 2:
                continue
            for consumer in self.consumers:
                consumer(*frames)
            self.messages += 1
            self.size += len(frames[0]) + len(frames[1])
            if frames[0].startswith(_TICKING):
                self._count(*frames)

    def _count(self, topic: bytes, body: bytes) -> None:
        try:
            message = self._decode(body)
        except msgspec.MsgspecError:
            return
        before, self._ticks[topic] = self._ticks.get(topic), message.tick
        if before is not None and message.tick > before:
            self.lost += (message.tick - before - 1) // max(message.every, 1)
