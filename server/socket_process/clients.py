"""Command clients of one endpoint: a ROUTER socket of libzmq."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable
from typing import Final

import zmq

from softfinger.server.socket_process.peer_socket import BoundEndpoint, KeyLock, PeerSocket, SocketContext
from softfinger.server.socket_process.setup import REQUEST_MAX, Kind

WAITING_MAX: Final = 64
"""Requests of a client, or answers to it, in the queue; further answers are dropped, because it does not read them."""
BURST_S: Final = 0.1
BURST: Final = 100
"""Most requests of a client in BURST_S: a thousand per second, one in each tick of the usual loop. More are busy."""


class Clients:
    """Command clients of one endpoint; `on_request` is called with kind, client and request."""

    def __init__(
        self,
        gate: SocketContext,
        bound: BoundEndpoint,
        lock: KeyLock | None,
        on_request: Callable[[Kind, bytes, bytes], object],
    ) -> None:
        options = {
            "maxmsgsize": REQUEST_MAX,
            "sndhwm": WAITING_MAX,
            "rcvhwm": WAITING_MAX,
            "router_mandatory": 1,
            "router_handover": 1,
        }
        self.peers: Final = PeerSocket(gate, zmq.ROUTER, bound, lock, options)
        self._on_request = on_request
        self._burst_counts: Counter[bytes] = Counter()
        self._burst_s = 0.0

    def take(self, has_room: Callable[[], bool]) -> None:
        """Pass on requests while there is room for another, from all clients in turn."""
        now = time.monotonic()
        if now - self._burst_s >= BURST_S:
            self._burst_s = now
            self._burst_counts.clear()
        while has_room() and self.peers.has_message:
            client, *frames = self.peers.socket.recv_multipart(zmq.NOBLOCK)
            self._burst_counts[client] += 1
            kind = Kind.TOO_MUCH if self._burst_counts[client] > BURST else Kind.REQUEST
            if len(frames) == 2 and not frames[0]:
                self._on_request(kind, client, frames[1])
            else:
                self._on_request(Kind.MALFORMED, client, b"")

    def answer(self, client: bytes, body: bytes) -> None:
        """Send an answer to a client; it is dropped if the client has disconnected or does not read."""
        with contextlib.suppress(zmq.ZMQError):
            self.peers.socket.send_multipart([client, b"", body], zmq.NOBLOCK)
