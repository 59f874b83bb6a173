"""Main loop of the gateway: a single thread for all its sockets."""

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
from softfinger.server.publishing.front import Front, Gate, Lock, bound_resources
from softfinger.server.publishing.readers import Readers
from softfinger.server.wire.endpoint import Bound

LOOK_S: Final = 1.0
"""Interval of the check of the folders of keys and of the count of connections."""
POLL_MS: Final = 100


class Source(NamedTuple):
    """Endpoint of a server, and the keys it requires."""

    endpoint: str
    keys: ClientKeys | None = None


class Way(NamedTuple):
    """Path of commands from a server to an endpoint for peers; without a lock, every peer in reach may connect."""

    source: Source
    bound: Bound
    lock: Lock | None = None


class Forward:
    """Forwarding of telemetry and commands.

    stream    source of the telemetry, if any
    readers   endpoint for ZeroMQ subscribers, with its lock
    commands  path of commands, if any
    outlets   streams of Lab Streaming Layer
    """

    def __init__(
        self,
        stream: Source | None,
        readers: tuple[Bound, Lock | None] | None = None,
        commands: Way | None = None,
        outlets: Outlets | None = None,
    ) -> None:
        self._files = ExitStack()
        self._context: zmq.Context[Any] = zmq.Context()
        self._files.callback(self._context.destroy, 0)
        self._begun_s = time.monotonic()
        self.stream = self.readers = self.commanders = None
        self.outlets: Final = outlets
        self._fronts: list[Front] = []
        try:
            authenticator = ThreadAuthenticator(self._context)
            authenticator.start()
            self._files.callback(authenticator.stop)
            gate = Gate(self._context, authenticator)
            if stream is not None:
                self.stream = Stream(self._context, *stream)
            if self.stream is not None and readers is not None:
                self.readers = Readers(gate, *readers, QUEUE)
                self.stream.takers.append(self.readers.send)
                self._open(self.readers.front)
            if self.stream is not None and outlets is not None:
                self.stream.takers.append(outlets.send)
            if commands is not None:
                self.commanders = Commanders(gate, *commands.source, commands.bound, commands.lock)
                self._files.callback(self.commanders.close)
                self._open(self.commanders.front)
        except zmq.ZMQError as error:
            self._files.close()
            raise ConfigError(f"nothing is forwarded: {error}; endpoints look like tcp://127.0.0.1:5555") from error
        except BaseException:
            self._files.close()
            raise

    def _open(self, front: Front) -> None:
        self._fronts.append(front)
        self._files.callback(front.close)

    def run(self, ended: Callable[[], bool], show: Callable[[str], None] | None = None) -> None:
        """Forward until the function `ended` returns True."""
        bound_resources()
        due = 0.0
        while not ended():
            ways = dict(self._ways())
            poller = zmq.Poller()
            for socket in ways:
                poller.register(socket, zmq.POLLIN)
            changed, renewed = False, self._renewed()
            while not (changed or ended()):
                for socket, _ in poller.poll(POLL_MS):
                    changed |= bool(ways[socket]())
                if (now := time.monotonic()) >= due:
                    due = now + LOOK_S
                    for front in self._fronts:
                        front.look()
                        front.look_at_keys()
                    if show is not None:
                        show(self.line())
                changed |= self._renewed() != renewed

    def _renewed(self) -> int:
        return sum(front.renewed for front in self._fronts)

    def _ways(self) -> Iterator[tuple[Any, Callable[[], Any]]]:
        """Yield each socket with its handler; a handler returns True if the set of sockets has changed."""
        if self.stream is not None:
            yield self.stream.socket, self.stream.take
        if self.readers is not None:
            yield self.readers.front.socket, self.readers.take
        if self.commanders is not None:
            yield self.commanders.front.socket, self.commanders.take
            for behind in self.commanders.sockets:
                yield behind, partial(self.commanders.answer, behind)

    def statistics(self) -> dict[str, Any]:
        """Return the counts of forwarded messages so far."""
        found: dict[str, Any] = {"seconds": time.monotonic() - self._begun_s}
        if self.stream is not None:
            found |= {"messages": self.stream.messages, "bytes": self.stream.size, "lost": self.stream.lost}
        if self.outlets is not None:
            found["lsl"] = {"streams": self.outlets.names, "samples": self.outlets.samples}
        for name, part in (("telemetry", self.readers), ("commands", self.commanders)):
            if part is not None:
                part.front.look()
                found[name] = {
                    "endpoint": part.front.endpoint,
                    "connections_max": part.front.most,
                    "refused": part.front.refused,
                }
        if self.commanders is not None:
            found["commands"] |= {
                "requests": self.commanders.requests,
                "answers": self.commanders.answers,
                "dropped": self.commanders.dropped,
            }
        return found

    def line(self) -> str:
        """Return the statistics as text."""
        found = self.statistics()
        said = []
        if "messages" in found:
            said.append(f"{found['messages']} messages, {found['lost']} ticks missing")
        if "lsl" in found:
            said.append(f"{found['lsl']['samples']} samples to LSL")
        said += [
            f"{name}: at most {found[name]['connections_max']} connections, {found[name]['refused']} refused"
            for name in ("telemetry", "commands")
            if name in found
        ]
        if "commands" in found:
            said.append(f"{found['commands']['requests']} requests")
        return "; ".join(said)

    def close(self) -> None:
        """Disconnect all; may be called repeatedly."""
        self._files.close()
