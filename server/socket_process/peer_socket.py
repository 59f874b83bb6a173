"""Socket of libzmq for peers: bound, protected by CURVE if keys are required, and recreated when a key is revoked."""

from __future__ import annotations

import contextlib
import os
import resource
import struct
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Protocol, cast

import zmq

if TYPE_CHECKING:  # they take time to import, and most daemons use no keys
    from zmq.auth.thread import ThreadAuthenticator

    from softfinger.server.keys import KeyPair
    from softfinger.server.socket_process.allowed import AllowedKeys

HANDSHAKE_MS: Final = 2000
LINGER_MS: Final = 200
"""Time for which the end waits until the last messages have been sent."""
SEND_BUFFER_BYTES: Final = 262144
"""Send buffer of the system for each peer; without a limit it grows to megabytes, which is latency for a subscriber."""
FILES_MAX: Final = 512
"""Limit of file descriptors, and so of connections: libzmq has none, and connections beyond it wait in the system's
queue."""
MEMORY_MAX: Final = 1 << 30
"""Limit of writable memory in bytes: a peer can make libzmq allocate without end. Beyond it, the process ends."""
COMMANDS_MEMORY_MAX: Final = 1 << 28
"""The same for a process of commands, which stores no messages for subscribers."""
_EVENT: Final = struct.Struct("=Hi")
"""First frame of a connection event, `zmq_socket_monitor(3)`; `zmq.utils.monitor` imports asyncio, half of the start of
the process."""
EVENTS_AT_ONCE: Final = 1024
"""Connection events handled per call: a peer that only connects and disconnects must not delay ticks."""
_REFUSED: Final = (
    zmq.EVENT_HANDSHAKE_FAILED_AUTH | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
)
_WATCHED: Final = zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED | _REFUSED


class BoundEndpoint(Protocol):
    """Endpoint that is already bound; its owner frees it."""

    @property
    def endpoint(self) -> str: ...

    @property
    def fd(self) -> int: ...


class KeyLock(NamedTuple):
    """Key pair of the server, and the keys of peers that may connect."""

    pair: KeyPair
    allowed: AllowedKeys


class SocketContext(NamedTuple):
    """Context of the sockets, and authenticator of keys; None if no key is required."""

    context: zmq.Context[Any]
    authenticator: ThreadAuthenticator | None


def open_context(files: ExitStack, linger_ms: int, has_keys: bool) -> SocketContext:
    """Return a context and, if keys are required, a running authenticator; closing `files` ends both."""
    context: zmq.Context[Any] = zmq.Context()
    files.callback(context.destroy, linger_ms)
    if not has_keys:
        return SocketContext(context, None)
    from zmq.auth.thread import ThreadAuthenticator

    authenticator = ThreadAuthenticator(context)
    authenticator.start()
    files.callback(authenticator.stop)
    return SocketContext(context, authenticator)


class PeerSocket:
    """Socket on an endpoint that is already bound; without a lock, every peer that reaches it may connect."""

    def __init__(
        self,
        socket_context: SocketContext,
        kind: int,
        bound: BoundEndpoint,
        lock: KeyLock | None,
        options: dict[str, int],
    ) -> None:
        self.endpoint: Final = bound.endpoint
        self.lock: Final = lock
        self._domain: Final = f"front-{kind}"
        """Name by which libzmq identifies this socket to the authenticator."""
        if lock is not None:  # before the first peer connects: a rejected peer does not connect again
            assert socket_context.authenticator is not None
            socket_context.authenticator.configure_curve_callback(self._domain, lock.allowed)
        self.max_connections = self.refused = 0
        """Largest number of simultaneous connections, and number of failed handshakes, for any reason."""
        self.renewals = 0
        """Number of times that all peers were disconnected; `socket` and `monitor` are replaced each time."""
        self._context, self._kind, self._bound, self._options = socket_context.context, kind, bound, options
        self.connected: Final[dict[int, int]] = {}
        """Number of each open connection, unique for this process, by its file descriptor, which the next may reuse."""
        self._accepted = 0
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
        self._bind()

    def _bind(self) -> None:
        # libzmq closes the listener with its socket, and another socket may follow.
        self.socket.setsockopt(zmq.USE_FD, os.dup(self._bound.fd))
        self.socket.bind(self.endpoint)

    def bind_again(self, fd: int) -> None:
        """Accept also the connections to a new listening socket; the present peers stay connected."""
        os.dup2(fd, self._bound.fd, inheritable=False)
        self._bind()

    @property
    def has_message(self) -> bool:
        return bool(cast(int, self.socket.getsockopt(zmq.EVENTS)) & zmq.POLLIN)

    def renew(self) -> None:
        """Disconnect all peers; allowed peers reconnect automatically."""
        self.connected.clear()
        self.socket.linger = 0
        self.close()
        self._open()
        self.renewals += 1

    def process_events(self, most: int = EVENTS_AT_ONCE) -> bool:
        """Process at most so many connection events; return whether there may be more."""
        more = False
        for _ in range(most):
            more = bool(self.monitor.poll(0))
            if not more:
                break
            event, value = _EVENT.unpack(self.monitor.recv_multipart()[0])
            if event & _REFUSED:
                self.refused += 1
            elif event == zmq.EVENT_ACCEPTED:
                self._accepted += 1
                self.connected[value] = self._accepted
            elif event == zmq.EVENT_DISCONNECTED:
                self.connected.pop(value, None)
        self.max_connections = max(self.max_connections, len(self.connected))
        return more

    def refresh_keys(self) -> None:
        """Read the folder of keys again; if a key was removed, disconnect all peers."""
        if self.lock is not None and self.lock.allowed.refresh():
            self.renew()

    def close(self) -> None:
        """Disconnect all peers; may be called repeatedly."""
        if not self.socket.closed:
            self.socket.disable_monitor()
            self.monitor.close()
            self.socket.close()


def bound_resources(memory_max: int = MEMORY_MAX) -> None:
    """Limit the resources that peers can use in this process, since libzmq does not limit them."""
    for kind, maximum in ((resource.RLIMIT_NOFILE, FILES_MAX), (resource.RLIMIT_DATA, memory_max)):
        with contextlib.suppress(ValueError, OSError):
            soft, hard = resource.getrlimit(kind)
            resource.setrlimit(kind, (maximum if soft < 0 else min(soft, maximum), hard))
    # Out of memory, libzmq aborts the process: that is expected, and no core file is needed.
    with contextlib.suppress(ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_CORE, (0, resource.getrlimit(resource.RLIMIT_CORE)[1]))
