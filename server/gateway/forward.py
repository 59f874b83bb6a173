"""Main loop of the gateway: a single thread for all sockets of a process."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from typing import Any, Final, NamedTuple

import zmq
from zmq.auth.thread import ThreadAuthenticator

from softfinger.config.errors import ConfigError
from softfinger.server.gateway.lsl import Outlets
from softfinger.server.gateway.requests import Commanders
from softfinger.server.gateway.streams import QUEUE, Stream
from softfinger.server.keys import ClientKeys
from softfinger.server.socket_process.peer_socket import KeyLock, PeerSocket, SocketContext, bound_resources
from softfinger.server.socket_process.readers import Readers
from softfinger.server.wire.endpoint import BoundSocket

KEY_CHECK_S: Final = 1.0
"""Interval of the check of the folders of keys and of the count of connections."""
POLL_MS: Final = 100


class ForwardedServer(NamedTuple):
    """Endpoint of a server, and the keys it requires."""

    endpoint: str
    keys: ClientKeys | None = None


class CommandPath(NamedTuple):
    """Path of commands from a server to an endpoint for peers; without a lock, every peer in reach may connect."""

    source: ForwardedServer
    bound: BoundSocket
    lock: KeyLock | None = None


class Forwarder:
    """Forwarding of telemetry and commands."""

    def __init__(
        self,
        stream: ForwardedServer | None,
        readers: tuple[BoundSocket, KeyLock | None] | None = None,
        commands: CommandPath | None = None,
        outlets: Outlets | None = None,
    ) -> None:
        self._files = ExitStack()
        self._context: zmq.Context[Any] = zmq.Context()
        self._files.callback(self._context.destroy, 0)
        self._start_s = time.monotonic()
        self.stream = self.readers = self.commanders = None
        self.outlets: Final = outlets
        self._peer_sockets: list[PeerSocket] = []
        try:
            authenticator = ThreadAuthenticator(self._context)
            authenticator.start()
            self._files.callback(authenticator.stop)
            gate = SocketContext(self._context, authenticator)
            if stream is not None:
                self.stream = Stream(self._context, *stream)
            if self.stream is not None and readers is not None:
                self.readers = Readers(gate, *readers, QUEUE)
                self.stream.consumers.append(self.readers.send)
                self._open(self.readers.peers)
            if self.stream is not None and outlets is not None:
                self.stream.consumers.append(outlets.send)
            if commands is not None:
                self.commanders = Commanders(gate, *commands.source, commands.bound, commands.lock)
                self._files.callback(self.commanders.close)
                self._open(self.commanders.peers)
        except zmq.ZMQError as error:
            self._files.close()
            raise ConfigError(f"nothing is forwarded: {error}; endpoints look like tcp://127.0.0.1:5555") from error
        except BaseException:
            self._files.close()
            raise

    def _open(self, peers: PeerSocket) -> None:
        self._peer_sockets.append(peers)
        self._files.callback(peers.close)

    def run(self, ended: Callable[[], bool], show: Callable[[str], None] | None = None) -> None:
        """Forward until `ended` returns True; call `show` with the counts once a second."""
        bound_resources()
        next_check_s = 0.0
        while not ended():
            handlers = dict(self._iter_handlers())
            poller = zmq.Poller()
            for socket in handlers:
                poller.register(socket, zmq.POLLIN)
            changed, renewals = False, self._count_renewals()
            while not (changed or ended()):
                for socket, _ in poller.poll(POLL_MS):
                    changed |= bool(handlers[socket]())
                if (now := time.monotonic()) >= next_check_s:
                    next_check_s = now + KEY_CHECK_S
                    for peers in self._peer_sockets:
                        peers.process_events()
                        peers.refresh_keys()
                    if show is not None:
                        show(describe(self.statistics()))
                changed |= self._count_renewals() != renewals

    def _count_renewals(self) -> int:
        return sum(peers.renewals for peers in self._peer_sockets)

    def _iter_handlers(self) -> Iterator[tuple[Any, Callable[[], Any]]]:
        """Yield each socket with its handler; a handler returns True if the set of sockets has changed."""
        if self.stream is not None:
            yield self.stream.socket, self.stream.take
        if self.readers is not None:
            yield self.readers.peers.socket, self.readers.take
        if self.commanders is not None:
            yield self.commanders.peers.socket, self.commanders.take
            for upstream in self.commanders.sockets:
                yield upstream, partial(self.commanders.answer, upstream)

    def statistics(self) -> dict[str, Any]:
        counts: dict[str, Any] = {"seconds": time.monotonic() - self._start_s}
        if self.stream is not None:
            counts |= {"messages": self.stream.messages, "bytes": self.stream.size, "lost": self.stream.lost}
        if self.outlets is not None:
            counts["lsl"] = {"streams": self.outlets.names, "samples": self.outlets.samples}
        for name, part in (("telemetry", self.readers), ("commands", self.commanders)):
            if part is not None:
                part.peers.process_events()
                counts[name] = {
                    "endpoint": part.peers.endpoint,
                    "connections_max": part.peers.max_connections,
                    "refused": part.peers.refused,
                }
        if self.commanders is not None:
            counts["commands"] |= {
                "requests": self.commanders.requests,
                "answers": self.commanders.answers,
                "dropped": self.commanders.dropped,
            }
        return counts

    def close(self) -> None:
        """Disconnect all; may be called repeatedly."""
        self._files.close()


def describe(statistics: dict[str, Any]) -> str:
    parts = []
    if "messages" in statistics:
        parts.append(f"{statistics['messages']} messages, {statistics['lost']} ticks missing")
    if "lsl" in statistics:
        parts.append(f"{statistics['lsl']['samples']} samples to LSL")
    parts += [
        f"{name}: at most {statistics[name]['connections_max']} connections, {statistics[name]['refused']} refused"
        for name in ("telemetry", "commands")
        if name in statistics
    ]
    if "commands" in statistics:
        parts.append(f"{statistics['commands']['requests']} requests")
    return "; ".join(parts)
