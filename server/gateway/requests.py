"""Commands through the gateway: a connection to the server for each client, so that limits apply to each separately."""

from __future__ import annotations

import contextlib
from collections import OrderedDict
from typing import Final

import zmq

from softfinger.server.keys import ClientKeys
from softfinger.server.publishing.front import Front, Gate, Lock
from softfinger.server.publishing.setup import ANSWER_MAX, REQUEST_MAX
from softfinger.server.wire.endpoint import Bound

CLIENTS_MAX: Final = 16
"""Clients at a time, half of the server's limit; another one replaces the client with the oldest last request."""
WAITING_MAX: Final = 64
"""Queued requests of a client, or answers to it; further ones are dropped."""


class Commanders:
    """Clients that command a server through the gateway."""

    def __init__(self, gate: Gate, endpoint: str, keys: ClientKeys | None, bound: Bound, lock: Lock | None) -> None:
        options = {"maxmsgsize": REQUEST_MAX, "sndhwm": WAITING_MAX, "rcvhwm": WAITING_MAX, "router_mandatory": 1}
        self.front: Final = Front(gate, zmq.ROUTER, bound, lock, options)
        self.requests = self.answers = self.dropped = 0
        self._context, self._endpoint, self._keys = gate.context, endpoint, keys
        self._behind: OrderedDict[bytes, zmq.Socket[bytes]] = OrderedDict()
        """Connection to the server for each client, by its identity; ordered by the last request."""

    @property
    def sockets(self) -> list[zmq.Socket[bytes]]:
        """Sockets that receive answers."""
        return list(self._behind.values())

    def take(self) -> bool:
        """Forward a request; return True if that opened or closed a connection to the server."""
        try:
            client, *frames = self.front.socket.recv_multipart(zmq.NOBLOCK)
        except zmq.Again:
            return False
        self.requests += 1
        known = client in self._behind
        try:
            behind = self._behind[client] if known else self._connect(client)
            self._behind.move_to_end(client)
            behind.send_multipart(frames, zmq.NOBLOCK)
        except zmq.ZMQError:  # too many are queued, or no file descriptor is left
            self.dropped += 1
        return not known

    def _connect(self, client: bytes) -> zmq.Socket[bytes]:
        while len(self._behind) >= CLIENTS_MAX:
            self._behind.popitem(last=False)[1].close()
        behind: zmq.Socket[bytes] = self._context.socket(zmq.DEALER)
        behind.linger, behind.sndhwm, behind.rcvhwm, behind.maxmsgsize = 0, WAITING_MAX, WAITING_MAX, ANSWER_MAX
        behind.ipv6 = "[" in self._endpoint
        if self._keys is not None:
            self._keys.put_on(behind)
        behind.connect(self._endpoint)
        self._behind[client] = behind
        return behind

    def answer(self, behind: zmq.Socket[bytes]) -> None:
        """Forward an answer to the client of the connection."""
        for client, socket in self._behind.items():
            if socket is behind:
                with contextlib.suppress(zmq.Again):
                    frames = behind.recv_multipart(zmq.NOBLOCK)
                    try:
                        self.front.socket.send_multipart([client, *frames], zmq.NOBLOCK)
                        self.answers += 1
                    except zmq.ZMQError:  # it has disconnected, or does not read
                        self.dropped += 1
                return

    def close(self) -> None:
        """Close all connections to the server."""
        for socket in self._behind.values():
            socket.close()
        self._behind.clear()
