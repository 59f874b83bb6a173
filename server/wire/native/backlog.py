"""The newest messages, kept once for all, and the peers, each of which is a place in them.

All of it is arrays behind one lock, which only kernels take. A peer is given what its socket takes at once. One that
falls behind by all that is kept gives up the older half, and what it missed is counted, message by message. A message
that was begun is finished, whatever becomes of the backlog: its rest is copied, and goes first.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels.native.jit import entry, jit
from softfinger.proxy.kernels.native.memory import address_of
from softfinger.proxy.kernels.native.outlined import outlined
from softfinger.server.wire.native.system import GONE, LOCK_WORDS, give, lock, ring, unlock

PEERS_MAX: Final = 64
"""Most connections at a time; a quarter of the file descriptors that the process may open, if that is fewer."""

CHUNK_BYTES: Final = 65536
"""Most that one peer is given at a time, and that waits for it besides the backlog: the rest of a message, answers."""

TOPICS_MAX: Final = 62
"""Topics are bits of a word."""

# Words of a backlog.
HEAD: Final = 0  # messages so far
OLDEST: Final = 1  # number of the oldest that is kept
END: Final = 2  # bytes so far, gaps at the end of `data` counted
LOST: Final = 3  # messages that peers were too slow to take, all together
TICK: Final = 4  # newest tick that was sent
BELL: Final = 5  # eventfd that wakes who sends to peers that wait
RETAINED: Final = 6  # topics, as bits, whose newest message a new subscriber is given at once
_WORDS: Final = 8

# Words of a peer.
FD: Final = 0  # -1: no peer is here
WANTED: Final = 1  # topics, as bits
NEXT: Final = 2  # number of the next message for it
WAITING: Final = 3  # the system's buffer is full, or it has had a chunk
BEGIN: Final = 4  # what is left of its part of `pending`
UNTIL: Final = 5
DEAD: Final = 6  # its socket takes nothing any more: whoever opened it is to close it
MISSED: Final = 7  # messages that it was too slow to take
_PEER_WORDS: Final = 8


class Backlog(NamedTuple):
    """lock     words of the lock
    words    HEAD to RETAINED
    data     (bytes,) uint8, the messages one after the other, none across the end
    begins   (messages,) where each begins, counted as END
    sizes    (messages,) of each, bytes
    topics   (messages,) of each, its number
    newest   (topics,) number of the newest message of each, -1 for none
    peers    (PEERS_MAX, words of a peer)
    pending  (PEERS_MAX, CHUNK_BYTES) uint8, what goes to each peer before the next message
    """

    lock: NDArray[np.int64]
    words: NDArray[np.int64]
    data: NDArray[np.uint8]
    begins: NDArray[np.int64]
    sizes: NDArray[np.int64]
    topics: NDArray[np.int64]
    newest: NDArray[np.int64]
    peers: NDArray[np.int64]
    pending: NDArray[np.uint8]


def make_backlog(messages: int, longest: int, topics: int, retained: int) -> Backlog:
    """Room for so many messages of `longest` bytes, and for fewer where some are longer; its pages come as they are
    used.

    retained  topics, as bits, whose newest message a new subscriber is given at once
    """
    if topics > TOPICS_MAX:
        raise ValueError(f"{topics} topics: there are bits for {TOPICS_MAX}")
    words = np.zeros(_WORDS, np.int64)
    words[TICK], words[BELL], words[RETAINED] = -1, -1, retained
    peers = np.zeros((PEERS_MAX, _PEER_WORDS), np.int64)
    peers[:, FD] = -1
    return Backlog(
        np.zeros(LOCK_WORDS, np.int64),
        words,
        np.empty(max(messages * longest, 2 * CHUNK_BYTES), np.uint8),
        np.zeros(messages, np.int64),
        np.zeros(messages, np.int64),
        np.zeros(messages, np.int64),
        np.full(topics, -1),
        peers,
        np.empty((PEERS_MAX, CHUNK_BYTES), np.uint8),
    )


def octets(data: bytes) -> NDArray[np.uint8]:
    """Bytes as `attend` and `broadcast` take them."""
    return np.frombuffer(bytearray(data), np.uint8) if data else np.zeros(0, np.uint8)


@entry
def attend(kept: Backlog, peer: int, fd: int, wanted: int, answer: NDArray[np.uint8]) -> None:
    """What is new of a peer, by whoever reads what it says.

    fd      its socket, -1: it is gone, and nothing is sent to it from here on
    wanted  topics it subscribes to, as bits
    answer  bytes for it, which are left out where it does not read and too much waits for it already
    """
    lock(kept.lock)
    if fd != kept.peers[peer, FD]:
        for word in range(_PEER_WORDS):
            kept.peers[peer, word] = 0
        kept.peers[peer, FD] = fd
    if fd >= 0:
        if kept.peers[peer, UNTIL] + len(answer) <= CHUNK_BYTES:
            for i in range(len(answer)):
                kept.pending[peer, kept.peers[peer, UNTIL] + i] = answer[i]
            kept.peers[peer, UNTIL] += len(answer)
        if wanted != kept.peers[peer, WANTED]:
            _subscribe(kept, peer, wanted)
        if kept.peers[peer, WAITING] == 0:
            advance(kept, peer)
            if kept.peers[peer, WAITING]:
                ring(kept.words[BELL])
    unlock(kept.lock)


@jit
def _subscribe(kept: Backlog, peer: int, wanted: int) -> None:
    before = kept.peers[peer, WANTED]
    if before == 0:
        kept.peers[peer, NEXT] = kept.words[HEAD]  # a subscription begins with the next message
    kept.peers[peer, WANTED] = wanted
    fresh = wanted & ~before & kept.words[RETAINED]
    for topic in range(len(kept.newest)):
        number = kept.newest[topic]
        if fresh >> topic & 1 and kept.words[OLDEST] <= number < kept.peers[peer, NEXT]:
            slot = number % len(kept.begins)
            if kept.peers[peer, UNTIL] + kept.sizes[slot] <= CHUNK_BYTES:
                _set_aside(kept, peer, kept.begins[slot], kept.sizes[slot])


@jit
def _set_aside(kept: Backlog, peer: int, begin: int, size: int) -> None:
    """Copy bytes of the backlog, `begin` counted as END, behind what is pending for a peer."""
    place = begin % len(kept.data)
    for i in range(size):
        kept.pending[peer, kept.peers[peer, UNTIL] + i] = kept.data[place + i]
    kept.peers[peer, UNTIL] += size


@entry
def broadcast(kept: Backlog, topic: int, message: NDArray[np.uint8]) -> None:
    """Send a message, at most CHUNK_BYTES long, to all who want its topic. From any thread; waits for no peer."""
    lock(kept.lock)
    place = append(kept, topic, len(message))
    for i in range(len(message)):
        kept.data[place + i] = message[i]
    if flush(kept):
        ring(kept.words[BELL])
    unlock(kept.lock)


@outlined
def append(kept: Backlog, topic: int, size: int) -> int:
    """Make room for one more message; returns its place in `data`, where it is to be written before the lock is
    let go."""
    messages, capacity, head = len(kept.begins), len(kept.data), kept.words[HEAD]
    begin = kept.words[END]
    if begin % capacity + size > capacity:
        begin += capacity - begin % capacity
    oldest = kept.words[OLDEST]
    while oldest < head and (head - oldest >= messages or kept.begins[oldest % messages] < begin + size - capacity):
        oldest += 1
    if oldest != kept.words[OLDEST]:
        kept.words[OLDEST] = oldest
        for peer in range(PEERS_MAX):
            here = kept.peers[peer, FD] >= 0 and kept.peers[peer, DEAD] == 0
            if here and kept.peers[peer, WANTED] and kept.peers[peer, NEXT] < oldest:
                _give_up(kept, peer, oldest + (head - oldest) // 2)
    slot = head % messages
    kept.begins[slot], kept.sizes[slot], kept.topics[slot] = begin, size, topic
    kept.newest[topic] = head
    kept.words[END] = begin + size
    kept.words[HEAD] = head + 1
    return int(begin % capacity)


@jit
def _give_up(kept: Backlog, peer: int, new: int) -> None:
    """A peer goes on with message `new`; what it misses is counted."""
    # Counting round by hand: LLVM makes a vector of a remainder in a loop, lane by lane, and compiles for seconds.
    missed, slot = 0, kept.peers[peer, NEXT] % len(kept.topics)
    for _ in range(kept.peers[peer, NEXT], new):
        missed += kept.peers[peer, WANTED] >> kept.topics[slot] & 1
        slot = 0 if slot + 1 == len(kept.topics) else slot + 1
    kept.peers[peer, NEXT] = new
    kept.peers[peer, MISSED] += missed
    kept.words[LOST] += missed


@jit
def flush(kept: Backlog) -> bool:
    """Give every peer that does not wait what there is for it; True if one of them waits from here on."""
    waits = False
    for peer in range(PEERS_MAX):
        if kept.peers[peer, FD] >= 0 and kept.peers[peer, WAITING] == 0:
            advance(kept, peer)
            waits = waits or kept.peers[peer, WAITING] != 0
    return waits


@outlined
def advance(kept: Backlog, peer: int) -> None:
    """Give a peer what its socket takes at once, up to CHUNK_BYTES, and see whether more waits for it."""
    me = kept.peers[peer]
    if me[DEAD]:
        return
    me[WAITING] = 1
    if me[BEGIN] < me[UNTIL]:
        taken = give(me[FD], address_of(kept.pending[peer], me[BEGIN]), me[UNTIL] - me[BEGIN])
        if taken == GONE:
            _leave(kept, peer)
            return
        me[BEGIN] += taken
        if me[BEGIN] < me[UNTIL]:
            return
    me[BEGIN] = me[UNTIL] = 0
    given = 0
    while given < CHUNK_BYTES:
        size = _skip_and_measure(kept, peer)
        if size == 0:
            me[WAITING] = 0
            return
        begin = kept.begins[me[NEXT] % len(kept.begins)]
        taken = give(me[FD], address_of(kept.data, begin % len(kept.data)), size)
        if taken == GONE:
            _leave(kept, peer)
            return
        given += taken
        left = taken
        while left > 0:
            one = kept.sizes[me[NEXT] % len(kept.sizes)]
            me[NEXT] += 1
            if left < one:
                _set_aside(kept, peer, begin + taken, one - left)
            left -= one
        if taken < size:
            return


@jit
def _leave(kept: Backlog, peer: int) -> None:
    kept.peers[peer, DEAD], kept.peers[peer, WAITING] = 1, 0


@jit
def _skip_and_measure(kept: Backlog, peer: int) -> int:
    """Pass over messages that a peer does not want; bytes of those that it does, and that lie one after the other."""
    wanted, head = kept.peers[peer, WANTED], kept.words[HEAD]
    number = kept.peers[peer, NEXT]
    messages = len(kept.begins)
    while number < head and wanted >> kept.topics[number % messages] & 1 == 0:
        number += 1
    kept.peers[peer, NEXT] = number
    size = 0
    first = kept.begins[number % messages]
    while number < head and wanted >> kept.topics[number % messages] & 1:
        slot = number % messages
        # A gap at the end of the data, or its end without one: what comes next lies at its beginning.
        apart = kept.begins[slot] != first + size or (size > 0 and kept.begins[slot] % len(kept.data) == 0)
        if apart or size + kept.sizes[slot] > CHUNK_BYTES:
            break
        size += kept.sizes[slot]
        number += 1
    return int(size)
