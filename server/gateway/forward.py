"""Main loop of the gateway, a single thread for all sockets of a process, and its two directions.

Telemetry: every message of a server is received once and passed to all consumers. Commands: a connection to the server
for each client, so that limits apply to each separately.
"""

from __future__ import annotations

import contextlib
import time
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from typing import Any, Final, NamedTuple

import msgspec
import zmq

from softfinger.config.errors import ConfigError
from softfinger.server.gateway.lsl import Outlets
from softfinger.server.keys import ClientKeys
from softfinger.server.socket_process.channel_messages import ANSWER_MAX, REQUEST_MAX
from softfinger.server.socket_process.peer_socket import (
    KeyLock,
    PeerSocket,
    SocketContext,
    bound_resources,
    open_context,
)
from softfinger.server.socket_process.subscribers import Subscribers
from softfinger.server.wire.client_requests import connect
from softfinger.server.wire.endpoint import BoundSocket
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
        self.socket.rcvhwm = QUEUE
        self.socket.subscribe(b"")
        connect(self.socket, endpoint, keys, MAX_BYTES)
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


CLIENTS_MAX: Final = 16
"""Largest number of clients, half of the server's limit; a further one replaces the client that was silent longest."""
WAITING_MAX: Final = 64
"""Queued requests of a client, or answers to it; further ones are dropped."""


class Commanders:
    """Clients that command a server through the gateway."""

    def __init__(
        self,
        socket_context: SocketContext,
        endpoint: str,
        keys: ClientKeys | None,
        bound: BoundSocket,
        lock: KeyLock | None,
    ) -> None:
        options = {"maxmsgsize": REQUEST_MAX, "sndhwm": WAITING_MAX, "rcvhwm": WAITING_MAX, "router_mandatory": 1}
        self.peers: Final = PeerSocket(socket_context, zmq.ROUTER, bound, lock, options)
        self.requests = self.answers = self.dropped = 0
        self._context, self._endpoint, self._keys = socket_context.context, endpoint, keys
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
        except (zmq.ZMQError, ConfigError):  # too many are queued, or no file descriptor is left
            self.dropped += 1
        return not is_known

    def _connect(self, client: bytes) -> zmq.Socket[bytes]:
        while len(self._upstream) >= CLIENTS_MAX:
            self._upstream.popitem(last=False)[1].close()
        upstream: zmq.Socket[bytes] = self._context.socket(zmq.DEALER)
        upstream.sndhwm = upstream.rcvhwm = WAITING_MAX
        connect(upstream, self._endpoint, self._keys, ANSWER_MAX)
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
        self._start_s = time.monotonic()
        self.stream = self.readers = self.commanders = None
        self.outlets: Final = outlets
        self._peer_sockets: list[PeerSocket] = []
        try:
            socket_context = open_context(self._files, linger_ms=0, has_keys=True)
            if stream is not None:
                self.stream = Stream(socket_context.context, *stream)
            if self.stream is not None and readers is not None:
                self.readers = Subscribers(socket_context, *readers, QUEUE)
                self.stream.consumers.append(self.readers.send)
                self._open(self.readers.peers)
            if self.stream is not None and outlets is not None:
                self.stream.consumers.append(outlets.send)
            if commands is not None:
                self.commanders = Commanders(socket_context, *commands.source, commands.bound, commands.lock)
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
        """Forward messages until `ended` returns True, and pass the counts to `show` once a second."""
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
