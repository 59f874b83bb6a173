"""Server of a gadget's process: commands in lines over a socket, answered in JSON, one at a time."""

from __future__ import annotations

import json
import os
import socket
from collections.abc import Callable


def serve(path: str, answer: Callable[[str], object]) -> None:
    """Answer lines until one is `quit`. A line that fails is answered with the error as text."""
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
                    reply = answer(line.strip())
                except Exception as error:
                    reply = f"{line.strip()}: {error!r}"
                stream.write(json.dumps(reply) + "\n")
                stream.flush()
