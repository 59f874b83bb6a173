"""Requests that wait until the daemon has answered earlier ones, in the order in which it receives them."""

from __future__ import annotations

from collections import OrderedDict, deque
from typing import Final

from softfinger.server.socket_process.brake import takes_force_off

QUEUED_MAX: Final = 1024
QUEUED_BYTES_MAX: Final = 1 << 22
"""Largest number of requests that wait, and of their bytes. Beyond them, requests that turn the force off are accepted
up to twice this number, and others from clients without a request that waits."""
CLIENTS_MAX: Final = 512
"""Largest number of such clients."""


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
