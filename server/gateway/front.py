"""A socket of libzmq for others: bound, locked by CURVE where they need keys, renewed when one of them loses his."""

from __future__ import annotations

import os
from typing import Any, Final, NamedTuple

import zmq
from zmq.auth.thread import ThreadAuthenticator
from zmq.utils.monitor import recv_monitor_message

from softfinger.server.gateway.allowed import Allowed
from softfinger.server.keys import Pair
from softfinger.server.wire.endpoint import Bound

HANDSHAKE_MS: Final = 2000
LINGER_MS: Final = 200
"""How long the end waits for the last messages to leave."""
_REFUSED: Final = (
    zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
)
_WATCHED: Final = zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED | _REFUSED


class Lock(NamedTuple):
    """The server's pair, and who may come in."""

    pair: Pair
    allowed: Allowed


class Gate(NamedTuple):
    """Where sockets are made, and who is asked about the keys of those who come."""

    context: zmq.Context[Any]
    authenticator: ThreadAuthenticator


class Front:
    """A socket of a kind on an endpoint that is bound already; without a lock everybody who reaches it may come in.

    options  of the socket, by name
    """

    def __init__(self, gate: Gate, kind: int, bound: Bound, lock: Lock | None, options: dict[str, int]) -> None:
        self.endpoint: Final = bound.endpoint
        self.lock: Final = lock
        self._domain: Final = f"front-{kind}"
        """What libzmq asks the authenticator about, with a peer's key."""
        if lock is not None:  # before the first one comes: who is turned away does not come again
            gate.authenticator.configure_curve_callback(self._domain, lock.allowed)
        self.most = self.refused = 0
        """Connections at a time, and handshakes that failed for want of a right key, so far."""
        self._context, self._kind, self._bound, self._options = gate.context, kind, bound, options
        self._connected: set[int] = set()
        self._open()

    def _open(self) -> None:
        self.socket: zmq.Socket[bytes] = self._context.socket(self._kind)
        self.socket.linger, self.socket.handshake_ivl = LINGER_MS, HANDSHAKE_MS
        for name, value in self._options.items():
            setattr(self.socket, name, value)
        if self.lock is not None:
            self.socket.curve_server = True
            self.socket.curve_publickey, self.socket.curve_secretkey = self.lock.pair
            self.socket.zap_domain = self._domain.encode()
            self.socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)
        self.monitor: zmq.Socket[bytes] = self.socket.get_monitor_socket(_WATCHED)
        # libzmq closes the listener with its socket, and there may be another one.
        self.socket.setsockopt(zmq.USE_FD, os.dup(self._bound.listener.fileno()))
        self.socket.bind(self.endpoint)

    def renew(self) -> None:
        """Cut everybody off; who may still come in connects again by himself."""
        self._connected.clear()
        self.socket.linger = 0
        self._close_socket()
        self._open()

    def look(self) -> None:
        """Take note of connections that came and went."""
        while self.monitor.poll(0):
            seen = recv_monitor_message(self.monitor)
            if seen["event"] & _REFUSED:
                self.refused += 1
            elif seen["event"] == zmq.EVENT_ACCEPTED:
                self._connected.add(seen["value"])
            elif seen["event"] == zmq.EVENT_DISCONNECTED:
                self._connected.discard(seen["value"])
        self.most = max(self.most, len(self._connected))

    def _close_socket(self) -> None:
        if not self.socket.closed:
            self.socket.disable_monitor()
            self.socket.close()

    def close(self) -> None:
        """Cut everybody off and free the endpoint. Any number of times."""
        self._close_socket()
        self._bound.files.close()
