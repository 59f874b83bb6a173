"""Requests from clients and answers to them: none of them can take the memory, the processor or the end from others.

One thread looks after all: it takes one request of each client in turn, and rests after that for as long as it has
worked. A client that does not read its answers is not read either, so what is kept for one is bounded by

    REQUEST_MAX + READ_BYTES + its answers
"""

from __future__ import annotations

import logging
import os
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from typing import Final

from softfinger.server.wire.endpoint import HANDSHAKE_S, LOG_PERIOD_S, part, room_for, said, watch, welcome
from softfinger.server.wire.zmtp import GREETING, MORE, Refused, Requests, frame

log: Final = logging.getLogger(__name__)

PEERS_MAX: Final = 32
"""Most connections at a time; an eighth of the file descriptors that the process may open, if that is fewer."""
PERIOD_S: Final = 0.02
"""How often `each_period` is called where nobody asks anything."""
REST_MAX_S: Final = 0.1
"""Longest rest: waiting for a lock is no work."""
BURST_S: Final = 0.1
BURST: Final = 100
"""Most requests of a client in a BURST_S: a thousand a second, one in each tick of the usual loop. More are busy."""
LINGER_S: Final = 0.2
"""How long the end waits for the last answers to leave."""


class Peer:
    """One connection."""

    def __init__(self, connection: socket.socket, number: int, now_s: float) -> None:
        self.socket, self.number = connection, number
        self.incoming = Requests()
        self.since_s = self.asked_s = self.burst_s = now_s
        self.burst = 0
        """Requests since `burst_s`."""
        self.pending = GREETING
        """Bytes on their way to it."""
        self.interest = 0


class Router:
    """Clients of a listening socket, which it takes over.

    answer       called with a client's number and its request (None: not two frames), and whether it asks too much;
                 returns the answer, or None if that comes later, by `reply`
    each_period  called every PERIOD_S or sooner

    Both are called in the thread that runs `run`, and raise nothing.
    """

    def __init__(
        self,
        listener: socket.socket,
        answer: Callable[[int, bytes | None, bool], bytes | None],
        each_period: Callable[[], None],
    ) -> None:
        self._listener, self._answer, self._each_period = listener, answer, each_period
        self._peers: dict[int, Peer] = {}
        self._late: deque[tuple[int, bytes]] = deque()
        self._lock = threading.Lock()
        self._number = 0
        self._refused = 0
        self._logged_s = -LOG_PERIOD_S
        self._peers_max = room_for(PEERS_MAX, 8)
        self._poll, self._wake = watch(listener)

    def reply(self, number: int, body: bytes) -> None:
        """Answer a client later than at once; from any thread. One that has gone gets nothing."""
        with self._lock:
            if self._wake >= 0:
                self._late.append((number, body))
                os.eventfd_write(self._wake, 1)

    def run(self, closing: threading.Event) -> None:
        """Look after the clients until `closing` is set."""
        due = 0.0
        while not closing.is_set():
            happened = self._poll.poll(PERIOD_S)
            begun = time.monotonic()
            for number, what in happened:
                self._look(number, what)
            for peer in tuple(self._peers.values()):
                self._take(peer, begun)
            self._send_late()
            if begun >= due:
                due = begun + PERIOD_S
                self._look_after(begun)
            self._each_period()
            if happened:  # a flood has half of the time of one processor at most, and the servo's readers the rest
                time.sleep(min(time.monotonic() - begun, REST_MAX_S))

    def close(self) -> None:
        """Send what is under way, for at most LINGER_S, and disconnect all. In the thread of `run`, or after it."""
        until = time.monotonic() + LINGER_S
        self._send_late()
        while any(peer.pending for peer in self._peers.values()) and time.monotonic() < until:
            for number, what in self._poll.poll(PERIOD_S):
                if number in self._peers and what & ~select.EPOLLIN:
                    self._send(self._peers[number])
        for peer in tuple(self._peers.values()):
            self._drop(peer)
        self._listener.close()
        self._poll.close()
        with self._lock:
            os.close(self._wake)
            self._wake = -1

    def _look(self, number: int, what: int) -> None:
        if number == self._listener.fileno():
            self._accept()
        elif number == self._wake:
            os.eventfd_read(self._wake)
        elif (peer := self._peers.get(number)) is not None:
            if what & select.EPOLLOUT:
                self._send(peer)
            if what & ~select.EPOLLOUT and number in self._peers:
                self._receive(peer)

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except BlockingIOError:
            return
        except OSError as error:  # no file descriptors are left, or it has gone already
            self._refuse(None, f"cannot be accepted: {error.strerror}")
            return
        now = time.monotonic()
        if len(self._peers) >= self._peers_max:
            # The one that has asked nothing for longest makes room: idle connections must not keep others out.
            idle = min(self._peers.values(), key=lambda peer: peer.asked_s)
            self._refuse(idle, f"is one more than the {self._peers_max} there may be")
        welcome(connection)
        self._number += 1
        peer = self._peers[connection.fileno()] = Peer(connection, self._number, now)
        self._poll.register(connection, 0)
        self._send(peer)

    def _receive(self, peer: Peer) -> None:
        data = said(peer.socket)
        if data is None:
            return
        if not data:
            self._drop(peer)
            return
        try:
            peer.pending += peer.incoming.feed(data)
        except Refused as reason:
            self._refuse(peer, str(reason))
            return
        self._send(peer)

    def _take(self, peer: Peer, now: float) -> None:
        """Answer the oldest request of a client that has read the answers to those before."""
        waiting = peer.incoming.waiting
        if not waiting or peer.pending:
            return
        if now - peer.burst_s >= BURST_S:
            peer.burst_s, peer.burst = now, 0
        peer.burst += 1
        peer.asked_s = now
        answer = self._answer(peer.number, waiting.popleft(), peer.burst > BURST)
        if answer is not None:
            peer.pending += _message(answer)
        self._send(peer)

    def _send_late(self) -> None:
        while self._late:
            number, body = self._late.popleft()
            for peer in tuple(self._peers.values()):
                if peer.number == number:
                    peer.pending += _message(body)
                    self._send(peer)

    def _send(self, peer: Peer) -> None:
        """Give the system what it takes at once, and see to what is waited for from this peer."""
        if peer.pending:
            try:
                peer.pending = peer.pending[peer.socket.send(peer.pending) :]
            except BlockingIOError:
                pass
            except OSError:  # it has gone
                self._drop(peer)
                return
        # A request that waits keeps the loop awake: who can take bytes is looked at again at once.
        interest = select.EPOLLOUT if peer.pending or peer.incoming.waiting else select.EPOLLIN
        if interest != peer.interest:
            peer.interest = interest
            self._poll.modify(peer.socket, interest)

    def _look_after(self, now: float) -> None:
        for peer in tuple(self._peers.values()):
            if not peer.incoming.ready and now - peer.since_s > HANDSHAKE_S:
                self._refuse(peer, f"does not finish the handshake within {HANDSHAKE_S:g} s")

    def _refuse(self, peer: Peer | None, reason: str) -> None:
        self._refused += 1
        now = time.monotonic()
        if now - self._logged_s >= LOG_PERIOD_S:  # seldom: a peer must not fill the log
            self._logged_s = now
            log.warning("commands: %d connections refused so far; the last: a peer %s", self._refused, reason)
        if peer is not None:
            self._drop(peer)

    def _drop(self, peer: Peer) -> None:
        del self._peers[peer.socket.fileno()]
        part(peer.socket)


def _message(body: bytes) -> bytes:
    return frame(MORE, b"") + frame(0, body)
