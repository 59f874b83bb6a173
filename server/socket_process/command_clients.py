"""Command clients of one endpoint, a ROUTER socket of libzmq, and the queue of their requests.

Requests wait until the daemon has answered earlier ones, in the order in which it receives them.
"""

from __future__ import annotations

import contextlib
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from typing import Annotated, Final

import msgspec
import zmq

from softfinger.server.socket_process.channel_messages import REQUEST_MAX
from softfinger.server.socket_process.force_off import takes_force_off
from softfinger.server.socket_process.peer_socket import BoundEndpoint, KeyLock, PeerSocket, SocketContext

QUEUED_MAX: Final = 1024
QUEUED_BYTES_MAX: Final = 1 << 22
"""Largest number of requests in the queue, and of their bytes. In a full queue, a request is accepted only from clients
without another. For requests that turn the force off, the queue is full at twice the number, of any size."""
CLIENTS_MAX: Final = 512
"""Number of clients in a full queue above which no further client is accepted."""


class RequestQueue:
    """Requests of all clients; clients take turns."""

    def __init__(self) -> None:
        self._requests = OrderedDict[bytes, deque[bytes]]()
        """Requests of each client; the client whose turn is next is the first."""
        self._count = self._bytes = 0

    def __len__(self) -> int:
        return self._count

    def add(self, client: bytes, body: bytes, too_much: bool) -> bool:
        """Append a request; return False if it is refused.

        too_much  the client sends too many; a request that turns the force off is accepted nevertheless
        """
        if takes_force_off(body):
            is_full, too_much = self._count >= 2 * QUEUED_MAX, False
        else:
            is_full = self._count >= QUEUED_MAX or self._bytes >= QUEUED_BYTES_MAX
        if too_much or (is_full and (client in self._requests or len(self._requests) >= CLIENTS_MAX)):
            return False
        self._requests.setdefault(client, deque()).append(body)
        self._count += 1
        self._bytes += len(body)
        return True

    def pop(self) -> tuple[bytes, bytes]:
        """Remove and return a client and its oldest request."""
        client, requests = self._requests.popitem(last=False)
        body = requests.popleft()
        if requests:
            self._requests[client] = requests
        self._count -= 1
        self._bytes -= len(body)
        return client, body


WAITING_MAX: Final = 64
"""Answers to a client in the queue; further ones are dropped, because it does not read them."""
UNREAD_MAX: Final = 8
"""Requests of a client that libzmq receives in advance, of up to REQUEST_MAX bytes each; further ones wait with the
client."""
BURST_S: Final = 0.1
BURST: Final = 100
"""Most requests of a client in BURST_S: a thousand per second, one in each tick of the usual loop. More are busy."""
REQUESTS_PER_TURN: Final = 64
"""Requests read in one turn."""
BUSY_MESSAGE: Final = "busy: too many requests from this client: send them more slowly"


class _CommandId(msgspec.Struct):
    command_id: Annotated[str, msgspec.Meta(max_length=128)] = ""


_decoder: Final = msgspec.msgpack.Decoder(_CommandId)


class CommandClients:
    """Command clients of one endpoint.

    on_request  is called with a client, its request (empty: not two frames), and whether it sends too many; returns
                whether the request was accepted; others are answered with BUSY_MESSAGE
    """

    def __init__(
        self,
        socket_context: SocketContext,
        bound: BoundEndpoint,
        lock: KeyLock | None,
        on_request: Callable[[bytes, bytes, bool], bool],
    ) -> None:
        options = {
            "maxmsgsize": REQUEST_MAX,
            "sndhwm": WAITING_MAX,
            "rcvhwm": UNREAD_MAX,
            "router_mandatory": 1,
            "router_handover": 1,
        }
        self.peers: Final = PeerSocket(socket_context, zmq.ROUTER, bound, lock, options)
        self._on_request = on_request
        self._burst_counts: Counter[bytes] = Counter()
        self._burst_s = 0.0

    def take(self) -> int:
        """Pass on or refuse at most REQUESTS_PER_TURN requests, from all clients in turn; return their number."""
        now = time.monotonic()
        if now - self._burst_s >= BURST_S:
            self._burst_s = now
            self._burst_counts.clear()
        for count in range(REQUESTS_PER_TURN):
            if not self.peers.has_message:
                return count
            client, *frames = self.peers.socket.recv_multipart(zmq.NOBLOCK)
            self._burst_counts[client] += 1
            body = frames[1] if len(frames) == 2 and not frames[0] else b""
            if not self._on_request(client, body, self._burst_counts[client] > BURST):
                self.answer(client, encode_busy(body))
        return REQUESTS_PER_TURN

    def answer(self, client: bytes, body: bytes) -> None:
        """Send an answer to a client; it is dropped if the client has disconnected or does not read."""
        with contextlib.suppress(zmq.ZMQError):
            self.peers.socket.send_multipart([client, b"", body], zmq.NOBLOCK)


def encode_busy(body: bytes) -> bytes:
    """Return the answer to a request that is one too many."""
    try:
        command_id = _decoder.decode(body).command_id
    except (msgspec.DecodeError, ValueError, RecursionError):
        command_id = ""
    return msgspec.msgpack.encode({"command_id": command_id, "success": False, "result": {}, "error": BUSY_MESSAGE})
