"""Who is connected: the door through which subscribers come, and by which those go that do harm.

A thread in Python reads what peers say, a few bytes each, and tells the sender (`native/`) who wants what; the
sender alone gives them messages. None of them can hold up the sender, another subscriber or the end: the newest
messages are kept once for all, and a subscriber is a place in them. So memory is bounded by

    backlog x the longest message of a tick + PEERS_MAX x (CHUNK_BYTES + 2 READ_BYTES + TOPICS_MAX x FRAME_MAX)

which is some 60 MB for the backlog and 6 MB for 64 peers, whatever they do.
"""

from __future__ import annotations

import logging
import os
import select
import socket
import threading
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

from softfinger.server.wire.endpoint import HANDSHAKE_S, LOG_PERIOD_S, part, room_for, said, watch, welcome
from softfinger.server.wire.native.backlog import DEAD, LOST, PEERS_MAX, WAITING, Backlog, attend, octets
from softfinger.server.wire.zmtp import GREETING, Incoming, Refused

log: Final = logging.getLogger(__name__)

PERIOD_S: Final = 0.1
"""How often those are looked after that do nothing."""
CLOSING_PERIOD_S: Final = 0.005
"""The same while the last messages leave."""
FRAMES_PER_S: Final = 64
"""Most frames of a peer in a second. A subscriber sends one a topic, and one a heartbeat."""
ACCEPTED_PER_PERIOD: Final = 16
"""New connections taken up in a period. More wait in the system's queue: a flood of them must not eat the processor."""


class Peer:
    """One connection; `number` is its place among the sender's peers."""

    def __init__(self, connection: socket.socket, number: int, now_s: float) -> None:
        self.socket, self.number = connection, number
        self.incoming = Incoming()
        self.since_s = now_s
        self.wanted = 0
        """Topics it subscribes to, as bits."""
        self.frames_s = now_s
        self.frames_before = 0


class Fanout:
    """Takes in whoever connects to `listener`, in a thread of its own; takes over the listener.

    topics    the topics there are, of which none begins another, as the backlog numbers them
    greetings what a new subscriber to a topic is sent at once, by topic; what the backlog retains comes besides
    backlog   messages and peers
    """

    def __init__(
        self, listener: socket.socket, topics: Sequence[bytes], greetings: Mapping[bytes, bytes], backlog: Backlog
    ) -> None:
        self._topics, self._greetings, self._backlog = tuple(topics), dict(greetings), backlog
        self._listener = listener
        self._peers: dict[int, Peer] = {}
        self._until_s: float | None = None
        self._listening = True
        self._accepted = 0
        self._logged_s = -LOG_PERIOD_S
        self._logged = (0, 0)
        self._reasons: Counter[str] = Counter()
        self._peers_max = room_for(PEERS_MAX, 4)
        self.refused = 0
        """Connections refused or cut off for what they did."""
        self.failed = False
        """The thread has ended by an error of its own, which is in the log: nobody can connect any more."""
        self._poll, self._wake = watch(listener)
        self._thread = threading.Thread(target=self._run, name="subscribers", daemon=True)
        self._thread.start()

    @property
    def subscribers(self) -> int:
        """Peers with at least one subscription that brings messages."""
        return sum(peer.wanted != 0 for peer in tuple(self._peers.values()))

    @property
    def lost(self) -> int:
        """Messages that subscribers were too slow to take, added up over all of them."""
        return int(self._backlog.words[LOST])

    def close(self, linger_s: float) -> None:
        """Send what is under way, for at most `linger_s`, and disconnect all. Once."""
        self._until_s = time.monotonic() + linger_s
        os.eventfd_write(self._wake, 1)
        self._thread.join(linger_s + 1.0)
        os.close(self._wake)  # not by the thread, which may have seen the end before it was woken

    def _run(self) -> None:
        try:
            due = time.monotonic() + PERIOD_S
            while not self._ended():
                for number, happened in self._poll.poll(PERIOD_S if self._until_s is None else CLOSING_PERIOD_S):
                    self._look(number, happened)
                if time.monotonic() >= due:
                    due = time.monotonic() + PERIOD_S
                    self._look_after()
        except Exception:
            self.failed = True
            log.exception("telemetry: the thread that takes subscribers in failed")
        finally:
            for peer in tuple(self._peers.values()):
                self._drop(peer)
            self._listener.close()
            self._poll.close()
            self._tell(time.monotonic(), last=True)

    def _ended(self) -> bool:
        if self._until_s is None:
            return False
        if self._listening:
            self._listening = False
            self._poll.unregister(self._listener)
            self._poll.unregister(self._wake)
        waiting = self._backlog.peers[:, WAITING]
        under_way = any(waiting[peer.number] for peer in self._peers.values() if peer.incoming.ready)
        return not under_way or time.monotonic() >= self._until_s

    def _look(self, number: int, happened: int) -> None:
        if number == self._listener.fileno():
            self._accept()
        elif (peer := self._peers.get(number)) is not None:
            self._receive(peer)

    def _accept(self) -> None:
        self._accepted += 1
        try:
            connection, _ = self._listener.accept()
        except BlockingIOError:
            return
        except OSError as error:  # no file descriptors are left, or it has gone already
            self._reasons[f"cannot be accepted: {error.strerror}"] += 1
            self.refused += 1
            self._accepted = ACCEPTED_PER_PERIOD
        else:
            self._welcome(connection)
        if self._accepted >= ACCEPTED_PER_PERIOD and self._listening:
            self._poll.modify(self._listener, 0)

    def _welcome(self, connection: socket.socket) -> None:
        if len(self._peers) >= self._peers_max:
            # One that subscribes to nothing makes room: idle connections must not keep subscribers out.
            idle = next((peer for peer in self._peers.values() if not peer.wanted), None)
            if idle is None:
                self._refuse(None, f"is one more than the {self._peers_max} there may be")
                connection.close()
                return
            self._refuse(idle, "subscribes to nothing, and its place is needed")
        welcome(connection)
        taken = {peer.number for peer in self._peers.values()}
        peer = Peer(connection, next(i for i in range(PEERS_MAX) if i not in taken), time.monotonic())
        self._peers[connection.fileno()] = peer
        self._poll.register(connection, select.EPOLLIN)
        self._attend(peer, GREETING)

    def _receive(self, peer: Peer) -> None:
        data = said(peer.socket)
        if data is None:
            return
        if not data:
            self._drop(peer)
            return
        try:
            answer = peer.incoming.feed(data)
            if peer.incoming.frames - peer.frames_before > FRAMES_PER_S:
                raise Refused(f"sends more than {FRAMES_PER_S} frames a second")
        except Refused as reason:
            self._refuse(peer, str(reason))
            return
        before, peer.wanted = peer.wanted, 0
        for number, topic in enumerate(self._topics):
            if any(map(topic.startswith, peer.incoming.topics)):
                peer.wanted |= 1 << number
                if not before >> number & 1:
                    answer += self._greetings.get(topic, b"")
        if answer or peer.wanted != before:
            self._attend(peer, answer)

    def _attend(self, peer: Peer, answer: bytes) -> None:
        attend(self._backlog, peer.number, peer.socket.fileno(), peer.wanted, octets(answer))

    def _look_after(self) -> None:
        now = time.monotonic()
        if self._listening and self._accepted:
            self._accepted = 0
            self._poll.modify(self._listener, select.EPOLLIN)
        for peer in tuple(self._peers.values()):
            if self._backlog.peers[peer.number, DEAD]:
                self._drop(peer)
            elif not peer.incoming.ready and now - peer.since_s > HANDSHAKE_S:
                self._refuse(peer, f"does not finish the handshake within {HANDSHAKE_S:g} s")
            elif now - peer.frames_s >= 1.0:
                peer.frames_s, peer.frames_before = now, peer.incoming.frames
        self._tell(now)

    def _tell(self, now: float, last: bool = False) -> None:
        """Say in the log what was lost and refused, seldom: a peer must not fill the log either."""
        if (self.lost, self.refused) == self._logged or (now - self._logged_s < LOG_PERIOD_S and not last):
            return
        if self.lost != self._logged[0]:
            log.warning("telemetry: subscribers were too slow and have lost %d messages so far", self.lost)
        if self.refused != self._logged[1]:
            ((reason, _),) = self._reasons.most_common(1)
            log.warning("telemetry: %d connections refused so far; most often: a peer %s", self.refused, reason)
        self._logged, self._logged_s = (self.lost, self.refused), now
        self._reasons.clear()

    def _refuse(self, peer: Peer | None, reason: str) -> None:
        self.refused += 1
        if len(self._reasons) < 100:  # sizes are in some of them, which a peer chooses
            self._reasons[reason] += 1
        if peer is not None:
            self._drop(peer)

    def _drop(self, peer: Peer) -> None:
        del self._peers[peer.socket.fileno()]
        attend(self._backlog, peer.number, -1, 0, octets(b""))  # before its file is closed, and perhaps another's
        part(peer.socket)
