"""Commands through the gateway: a connection to the server for each client, so that limits apply to each separately."""

from __future__ import annotations

import contextlib
from collections import OrderedDict
from typing import Final

import zmq

from softfinger.server.keys import ClientKeys
from softfinger.server.socket_process.peer_socket import KeyLock, PeerSocket, SocketContext
from softfinger.server.socket_process.setup import ANSWER_MAX, REQUEST_MAX
from softfinger.server.wire.endpoint import BoundSocket

CLIENTS_MAX: Final = 16
"""Largest number of clients, half of the server's limit; a further one replaces the client that was silent longest."""
WAITING_MAX: Final = 64
"""Queued requests of a client, or answers to it; further ones are dropped."""


class Commanders:
    """Clients that command a server through the gateway."""

    def __init__(
        self, gate: SocketContext, endpoint: str, keys: ClientKeys | None, bound: BoundSocket, lock: KeyLock | None
    ) -> None:
        options = {"maxmsgsize": REQUEST_MAX, "sndhwm": WAITING_MAX, "rcvhwm": WAITING_MAX, "router_mandatory": 1}
        self.peers: Final = PeerSocket(gate, zmq.ROUTER, bound, lock, options)
        self.requests = self.answers = self.dropped = 0
        self._context, self._endpoint, self._keys = gate.context, endpoint, keys
        self._upstream: OrderedDict[bytes, zmq.Socket[bytes]] = OrderedDict()
        """Connection to the server for each client, by its identity; ordered by the last request."""

    @property
    def sockets(self) -> list[zmq.Socket[bytes]]:
        return list(self._upstream.values())

    def take(self) -> bool:
        """Forward a request; return True if that opened or closed a connection to the server."""
        try:
            client, *frames = self.peers.socket.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            return False
        self.requests += 1
        is_known = client in self._upstream
        try:
            upstream = self._upstream[client] if is_known else self._connect(client)
            self._upstream.move_to_end(client)
            upstream.send_multipart(frames, zmq.NOBLOCK)
        except zmq.ZMQError:  # too many are queued, or no file descriptor is left
            self.dropped += 1
        return not is_known

    def _connect(self, client: bytes) -> zmq.Socket[bytes]:
        while len(self._upstream) >= CLIENTS_MAX:
            self._upstream.popitem(last=False)[1].close()
        upstream: zmq.Socket[bytes] = self._context.socket(zmq.DEALER)
        upstream.linger, upstream.sndhwm, upstream.rcvhwm, upstream.maxmsgsize = 0, WAITING_MAX, WAITING_MAX, ANSWER_MAX
        upstream.ipv6 = "[" in self._endpoint
        if self._keys is not None:
            self._keys.apply_to(upstream)
        upstream.connect(self._endpoint)
        self._upstream[client] = upstream
        return upstream

    def answer(self, upstream: zmq.Socket[bytes]) -> None:
        for client, socket in self._upstream.items():
            if socket is upstream:
                with contextlib.suppress(zmq.Again):
                    frames = upstream.recv_multipart(zmq.NOBLOCK)
                    try:
                        self.peers.socket.send_multipart([client, *frames], zmq.NOBLOCK)
                        self.answers += 1
                    except zmq.ZMQError:  # it has disconnected, or does not read
                        self.dropped += 1
                return

    def close(self) -> None:
        for socket in self._upstream.values():
            socket.close()
        self._upstream.clear()
