"""Subscribers of one endpoint: an XPUB socket of libzmq, with counts of lost messages and of subscriptions."""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable
from typing import Final

import zmq

from softfinger.server.socket_process.peer_socket import BoundEndpoint, KeyLock, PeerSocket, SocketContext

log: Final = logging.getLogger(__name__)

SUBSCRIPTION_MAX: Final = 512
"""Longest frame of a subscriber, bytes."""
SUBSCRIPTIONS_PER_S: Final = 256
"""New topics of one key; above this the key is barred. A program has one or two for each connection."""
TOPICS_MAX: Final = 256
"""Topics counted for one connection: bounds the memory for a peer that subscribes without end."""
EVENTS_PER_TURN: Final = 256


class Subscribers:
    """Subscribers of one endpoint.

    queue            messages queued for a slow subscriber; beyond that, libzmq drops new messages for it
    on_subscription  called with each topic, or prefix of topics, of a new subscription
    """

    def __init__(
        self,
        socket_context: SocketContext,
        bound: BoundEndpoint,
        lock: KeyLock | None,
        queue: int,
        on_subscription: Callable[[bytes], None] | None = None,
    ) -> None:
        options = {"sndhwm": queue, "maxmsgsize": SUBSCRIPTION_MAX, "xpub_verboser": 1, "xpub_nodrop": 1}
        self.peers: Final = PeerSocket(socket_context, zmq.XPUB, bound, lock, options)
        self.lost = 0
        """Messages at which a subscriber was found to be too slow; libzmq does not report losses after these."""
        self._on_subscription = on_subscription
        self._topics: dict[int, Counter[bytes]] = {}
        """Subscriptions of each connection, by its number in `PeerSocket.connected`."""
        self._new: Counter[bytes] = Counter()
        self._since_s = 0.0

    @property
    def connection_count(self) -> int:
        """Number of connections that subscribe to at least one topic."""
        return sum(bool(self._topics.get(number)) for number in self.peers.connected.values())

    def send(self, topic: bytes, body: bytes) -> None:
        """Send to all subscribers of the topic; never waits."""
        socket = self.peers.socket
        try:
            socket.send(topic, zmq.SNDMORE | zmq.NOBLOCK)
        except zmq.Again:  # sent to no subscriber: now send to all that have room
            self.lost += 1
            socket.xpub_nodrop = 0
            socket.send(topic, zmq.SNDMORE | zmq.NOBLOCK)
            socket.xpub_nodrop = 1
        socket.send(body, zmq.NOBLOCK)

    def take(self) -> None:
        """Read new subscriptions; if a key is barred for their number, disconnect all peers."""
        now = time.monotonic()
        if now - self._since_s >= 1.0:
            self._since_s, self._new = now, Counter()
            connected = set(self.peers.connected.values())
            self._topics = {number: topics for number, topics in self._topics.items() if number in connected}
        for _ in range(EVENTS_PER_TURN):
            if not self.peers.has_message:
                return
            frame = self.peers.socket.recv(zmq.NOBLOCK, copy=False)
            try:
                file = int(frame.get(zmq.SRCFD))
            except zmq.ZMQError:  # from libzmq itself, for a connection that has closed
                continue
            frame_bytes = frame.bytes
            self._count(file, frame_bytes[:1], frame_bytes[1:])
            if frame_bytes[:1] == b"\1" and self._on_subscription is not None:
                self._on_subscription(frame_bytes[1:])
            if self.peers.lock is not None and self._is_flooding(frame):
                return

    def _count(self, file: int, kind: bytes, topic: bytes) -> None:
        """Count a subscription (1) or its end (0) for the connection with this file descriptor.

        libzmq also passes on ends of subscriptions that never existed. They must not cancel subscriptions of other
        connections.
        """
        self.peers.process_events()  # libzmq reports a connection before its first frame
        number = self.peers.connected.get(file)
        if number is None:
            return
        topics = self._topics.setdefault(number, Counter())
        if kind == b"\1" and (topic in topics or len(topics) < TOPICS_MAX):
            topics[topic] += 1
        elif kind == b"\0" and topic in topics:
            topics[topic] -= 1
            if not topics[topic]:
                del topics[topic]

    def _is_flooding(self, frame: zmq.Frame) -> bool:
        lock = self.peers.lock
        assert lock is not None
        try:
            key = str(frame.get("User-Id")).encode()
        except zmq.ZMQError:  # of a peer that has disconnected
            return False
        self._new[key] += 1
        if self._new[key] <= SUBSCRIPTIONS_PER_S:
            return False
        log.warning("key %s is blocked: more than %d topics in 1 s", lock.allowed.name(key), SUBSCRIPTIONS_PER_S)
        lock.allowed.revoke(key)
        lock.allowed.refresh()
        self.peers.renew()
        return True
