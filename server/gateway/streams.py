"""Telemetry through the gateway: every message of a server, once, to whoever subscribes here, by libzmq's XPUB."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable
from typing import Any, Final

import msgspec
import zmq

from softfinger.server.gateway.front import Front, Gate, Lock
from softfinger.server.keys import ClientKeys
from softfinger.server.wire.endpoint import Bound
from softfinger.server.wire.protocol import CONTACT, FINGERS, MAX_BYTES

log: Final = logging.getLogger(__name__)

QUEUE: Final = 8192
"""Messages that wait for a slow subscriber, 8 s at 1 kHz; then libzmq drops the newest, for that one."""
SUBSCRIPTION_MAX: Final = 512
"""Longest frame of a subscriber, bytes."""
SUBSCRIPTIONS_PER_S: Final = 256
"""Of one key, new topics: above, the key is barred. A program has one or two for each connection."""
AT_ONCE: Final = 256

_TICKING: Final = (CONTACT.encode(), FINGERS.encode())


class _Tick(msgspec.Struct):
    """What of a message tells whether one is missing."""

    tick: int
    every: int


class Stream:
    """A subscription to a server, and what has come of it.

    Subscribers' topics are not passed on: the server hears of one subscriber, whatever they do.
    """

    def __init__(self, context: zmq.Context[Any], endpoint: str, keys: ClientKeys | None) -> None:
        self.socket: zmq.Socket[bytes] = context.socket(zmq.SUB)
        self.socket.linger, self.socket.rcvhwm, self.socket.maxmsgsize = 0, QUEUE, MAX_BYTES
        self.socket.ipv6 = "[" in endpoint
        if keys is not None:
            keys.put_on(self.socket)
        self.socket.subscribe(b"")
        self.socket.connect(endpoint)
        self.takers: list[Callable[[list[bytes]], None]] = []
        """What each message is given to."""
        self.messages = self.size = self.lost = 0
        """Messages and their bytes so far, and ticks that are missing among them."""
        self._decode = msgspec.msgpack.Decoder(_Tick).decode
        self._ticks: dict[bytes, int] = {}

    def take(self) -> None:
        """Hand on what has come."""
        for _ in range(AT_ONCE):
            try:
                frames = self.socket.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            if len(frames) != 2:
                continue
            for taker in self.takers:
                taker(frames)
            self.messages += 1
            self.size += len(frames[0]) + len(frames[1])
            if frames[0].startswith(_TICKING):
                self._count(*frames)

    def _count(self, topic: bytes, body: bytes) -> None:
        try:
            seen = self._decode(body)
        except msgspec.MsgspecError:
            return
        before, self._ticks[topic] = self._ticks.get(topic), seen.tick
        if before is not None and seen.tick > before:
            self.lost += (seen.tick - before - 1) // max(seen.every, 1)


class Readers:
    """Whoever subscribes to a stream here."""

    def __init__(self, gate: Gate, bound: Bound, lock: Lock | None) -> None:
        self.front: Final = Front(gate, zmq.XPUB, bound, lock, {"sndhwm": QUEUE, "maxmsgsize": SUBSCRIPTION_MAX})
        self._new: Counter[bytes] = Counter()
        self._since_s = 0.0

    def send(self, frames: list[bytes]) -> None:
        """To everybody who has subscribed to it; waits for nobody."""
        self.front.socket.send_multipart(frames)

    def take(self) -> bool:
        """Read the subscriptions that have come; True where a key was barred for them, and all were cut off."""
        now = time.monotonic()
        if now - self._since_s >= 1.0:
            self._since_s, self._new = now, Counter()
        for _ in range(AT_ONCE):
            try:
                frame = self.front.socket.recv(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                return False
            if self.front.lock is None:
                continue
            try:
                key = str(frame.get("User-Id")).encode()
            except zmq.ZMQError:  # of a peer that has gone
                continue
            self._new[key] += 1
            if self._new[key] > SUBSCRIPTIONS_PER_S:
                allowed = self.front.lock.allowed
                log.warning("key %s is barred: more than %d topics in 1 s", allowed.name(key), SUBSCRIPTIONS_PER_S)
                allowed.bar(key)
                allowed.refresh()
                self.front.renew()
                return True
        return False
