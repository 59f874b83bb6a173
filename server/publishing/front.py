"""A socket of libzmq for others: bound, locked by CURVE where they need keys, renewed when one of them loses his."""

from __future__ import annotations

import contextlib
import os
import resource
import struct
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol, cast

import zmq

if TYPE_CHECKING:  # they take time to import, and most daemons know no keys
    from zmq.auth.thread import ThreadAuthenticator

    from softfinger.server.gateway.allowed import Allowed
    from softfinger.server.keys import Pair

HANDSHAKE_MS: Final = 2000
LINGER_MS: Final = 200
"""How long the end waits for the last messages to leave."""
SEND_BUFFER_BYTES: Final = 262144
"""Of the system, for each peer; without a limit it grows to megabytes, which is latency for a subscriber."""
FILES_MAX: Final = 256
"""File descriptors, and so connections: libzmq has no bound of its own, and leaves those in the system's queue that it
has none for."""
MEMORY_MAX: Final = 1 << 30
"""Bytes that the process may write to: a peer can have libzmq keep more and more. Then this process ends."""
EVENTS_AT_ONCE: Final = 1024
"""Comings and goings that are taken note of at a time: who does nothing else must not keep ticks from being sent."""
_REFUSED: Final = (
    zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
)
_WATCHED: Final = zmq.EVENT_HANDSHAKE_SUCCEEDED | zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED | _REFUSED


class Open(Protocol):
    """An endpoint that is bound already, by whoever frees it."""

    @property
    def endpoint(self) -> str: ...

    @property
    def fd(self) -> int: ...


class Lock(NamedTuple):
    """The server's pair, and who may come in."""

    pair: Pair
    allowed: Allowed


class Gate(NamedTuple):
    """Where sockets are made, and who is asked about the keys of those who come; None where nobody needs any."""

    context: zmq.Context[Any]
    authenticator: ThreadAuthenticator | None


class Front:
    """A socket of a kind on an endpoint that is bound already; without a lock everybody who reaches it may come in.

    options  of the socket, by name
    """

    def __init__(self, gate: Gate, kind: int, bound: Open, lock: Lock | None, options: dict[str, int]) -> None:
        self.endpoint: Final = bound.endpoint
        self.lock: Final = lock
        self._domain: Final = f"front-{kind}"
        """What libzmq asks the authenticator about, with a peer's key."""
        if lock is not None:  # before the first one comes: who is turned away does not come again
            assert gate.authenticator is not None
            gate.authenticator.configure_curve_callback(self._domain, lock.allowed)
        self.most = self.refused = 0
        """Connections at a time, and those whose handshake failed, for want of a key or otherwise, so far."""
        self.renewed = 0
        """How often all were cut off: then `socket` and `monitor` are others."""
        self._context, self._kind, self._bound, self._options = gate.context, kind, bound, options
        self._connected: set[int] = set()
        self._let_in = 0
        """Handshakes that were finished, less connections that went after that."""
        self._open()

    def _open(self) -> None:
        self.socket: zmq.Socket[bytes] = self._context.socket(self._kind)
        self.socket.linger, self.socket.handshake_ivl, self.socket.sndbuf = LINGER_MS, HANDSHAKE_MS, SEND_BUFFER_BYTES
        for name, value in self._options.items():
            setattr(self.socket, name, value)
        if self.lock is not None:
            self.socket.curve_server = True
            self.socket.curve_publickey, self.socket.curve_secretkey = self.lock.pair
            self.socket.zap_domain = self._domain.encode()
            self.socket.setsockopt(zmq.ZAP_ENFORCE_DOMAIN, 1)
        self.monitor: zmq.Socket[bytes] = self.socket.get_monitor_socket(_WATCHED)
        # libzmq closes the listener with its socket, and there may be another one.
        self.socket.setsockopt(zmq.USE_FD, os.dup(self._bound.fd))
        self.socket.bind(self.endpoint)

    @property
    def has_come(self) -> bool:
        """Whether there is something to be received."""
        return bool(cast(int, self.socket.getsockopt(zmq.EVENTS)) & zmq.POLLIN)

    @property
    def peers(self) -> int:
        """Connections that have finished their handshake."""
        return min(self._let_in, len(self._connected))

    def renew(self) -> None:
        """Cut everybody off; who may still come in connects again by himself."""
        self._connected.clear()
        self._let_in = 0
        self.socket.linger = 0
        self.close()
        self._open()
        self.renewed += 1

    def look(self) -> None:
        """Take note of connections that came and went."""
        for _ in range(EVENTS_AT_ONCE):
            if not self.monitor.poll(0):
                break
            # As zmq_socket_monitor(3) has it; `zmq.utils.monitor` imports asyncio, a third of this process's start.
            event, value = struct.unpack("=Hi", self.monitor.recv_multipart()[0])
            if event & _REFUSED:
                self.refused += 1
                self._let_in += 1  # its end is told, too
            elif event == zmq.EVENT_ACCEPTED:
                self._connected.add(value)
            elif event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                self._let_in += 1
            elif event == zmq.EVENT_DISCONNECTED:
                self._connected.discard(value)
                self._let_in -= 1
        self.most = max(self.most, len(self._connected))

    def look_at_keys(self) -> None:
        """Read the folder of keys anew; whose key is gone is cut off, and the others with it."""
        if self.lock is not None and self.lock.allowed.refresh():
            self.renew()

    def close(self) -> None:
        """Cut everybody off. Any number of times."""
        if not self.socket.closed:
            self.socket.disable_monitor()
            self.socket.close()


def bound_resources() -> None:
    """What peers can take of this process has an end, whatever libzmq keeps for them."""
    for kind, most in ((resource.RLIMIT_NOFILE, FILES_MAX), (resource.RLIMIT_DATA, MEMORY_MAX)):
        with contextlib.suppress(ValueError, OSError):
            soft, hard = resource.getrlimit(kind)
            resource.setrlimit(kind, (most if soft < 0 else min(soft, most), hard))
    # Out of memory libzmq ends the process by abort: that is expected, and no core file is wanted.
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
