"""Command clients of one endpoint: a ROUTER socket of libzmq, read only while few requests are unanswered."""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable
from typing import Final

import zmq

from softfinger.server.publishing.front import Front, Gate, Lock, Open
from softfinger.server.publishing.setup import REQUEST_MAX, Kind

WAITING_MAX: Final = 64
"""Requests of a client, or answers to it, in the queue; further answers are dropped, because it does not read them."""
BURST_S: Final = 0.1
BURST: Final = 100
"""Most requests of a client in BURST_S: a thousand per second, one in each tick of the usual loop. More are busy."""


class Clients:
    """Command clients of one endpoint; `ask` is called with kind, client and request."""

    def __init__(self, gate: Gate, bound: Open, lock: Lock | None, ask: Callable[[Kind, bytes, bytes], object]) -> None:
        options = {
            "maxmsgsize": REQUEST_MAX,
            "sndhwm": WAITING_MAX,
            "rcvhwm": WAITING_MAX,
            "router_mandatory": 1,
            "router_handover": 1,
        }
        self.front: Final = Front(gate, zmq.ROUTER, bound, lock, options)
        self._ask = ask
        self._asked: Counter[bytes] = Counter()
        self._burst_s = 0.0

    def take(self, most: int) -> int:
        """Pass on at most `most` requests, from all clients in turn; return their number."""
        now = time.monotonic()
        if now - self._burst_s >= BURST_S:
            self._burst_s = now
            self._asked.clear()
        taken = 0
        while taken < most and self.front.has_come:
            client, *frames = self.front.socket.recv_multipart(zmq.NOBLOCK)
            self._asked[client] += 1
            kind = Kind.TOO_MUCH if self._asked[client] > BURST else Kind.REQUEST
            if len(frames) == 2 and not frames[0]:
                self._ask(kind, client, frames[1])
            else:
                self._ask(Kind.MALFORMED, client, b"")
            taken += 1
        return taken

    def answer(self, client: bytes, body: bytes) -> None:
        """Send an answer to a client; it is dropped if the client has disconnected or does not read."""
        with contextlib.suppress(zmq.ZMQError):
            self.front.socket.send_multipart([client, b"", body], zmq.NOBLOCK)
