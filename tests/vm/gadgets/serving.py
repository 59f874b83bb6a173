"""Server of a gadget's process: commands in lines over a socket, answered in JSON, one at a time."""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Callable

SETTLED_S, SETTLE_S = 0.05, 1.0
"""Silence after which nothing is in flight or queued in the kernel, and the maximum time to wait for it."""


def settle(last_at: Callable[[], float]) -> None:
    """Wait for silence after the last packet of the host, whose time is that of the monotonic clock."""
    started = time.monotonic()
    while time.monotonic() < min(started + SETTLE_S, max(started, last_at()) + SETTLED_S):
        time.sleep(0.005)


def serve(path: str, device: object) -> None:
    """Answer lines until one is `quit`; others name a method of the device and its argument, if any.

    A line that fails is answered with the error as text.
    """
    server = socket.socket(socket.AF_UNIX)
    server.bind(f"{path}.new")
    server.listen()
    os.rename(f"{path}.new", path)  # the socket listens as soon as the path exists
    while True:
        end, _ = server.accept()
        with end, end.makefile("rw") as stream:
            for line in stream:
                if line.strip() == "quit":
                    return
                try:
                    method, *arguments = line.split()
                    reply = getattr(device, method)(*arguments)
                except Exception as error:
                    reply = f"{line.strip()}: {error!r}"
                stream.write(json.dumps(reply) + "\n")
                stream.flush()
