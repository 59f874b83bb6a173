"""ZeroMQ addresses of a daemon: what may be bound, what is open to the network, and where commands are taken."""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path
from typing import Final

_TCP: Final = re.compile(r"tcp://(\[[^\]]*\]|[^:/@\[\]]+):(\*|[0-9]{1,5})")
_LOOPBACK: Final = re.compile(r"localhost|127(\.[0-9]{1,3}){3}|\[::1\]")
_PORT_MAX: Final = 65535
IPC_PATH_MAX: Final = 107
"""Bytes of a Unix socket's path."""


BESIDE: Final = ".commands"
"""What a socket of commands is called by, behind the port or the path of the telemetry."""


def runtime_folder() -> Path:
    """`softfinger` in $XDG_RUNTIME_DIR, or where that is not set a folder of this user in the temp directory; whether
    it is there or not."""
    given = os.environ.get("XDG_RUNTIME_DIR", "")
    if given.startswith("/"):
        return Path(given) / "softfinger"
    return Path(tempfile.gettempdir()) / f"softfinger-{os.geteuid()}"


def commands_beside(telemetry: str) -> str:
    """Where commands are taken of a daemon with this telemetry, where its rig does not say.

    A socket that this user alone reaches: the path with .commands behind, of a port on loopback one in the user's
    runtime folder, named by the port. Beside telemetry that is open to the network the next port, by key as that.
    """
    if telemetry.startswith("ipc://"):
        return f"{telemetry}{BESIDE}"
    host, _, port = telemetry.rpartition(":")
    if not is_public(telemetry):
        return f"ipc://{runtime_folder()}/{port}{BESIDE}"
    if not port.isdecimal() or port == "0":
        return telemetry
    return f"{host}:{int(port) + (1 if int(port) < _PORT_MAX else -1)}"


def telemetry_of(endpoint: str) -> str:
    """Where the daemon of an address publishes, which may be that of a socket of commands beside the telemetry;
    otherwise the address itself."""
    if not endpoint.startswith("ipc://") or not endpoint.endswith(BESIDE):
        return endpoint
    path = Path(endpoint.removeprefix("ipc://").removesuffix(BESIDE))
    return f"tcp://127.0.0.1:{path.name}" if path.parent == runtime_folder() else f"ipc://{path}"


def is_public(endpoint: str) -> bool:
    """Whether other machines may reach what is bound to a valid endpoint."""
    match = _TCP.fullmatch(endpoint)
    return match is not None and not _LOOPBACK.fullmatch(match[1])


def endpoint_complaint(endpoint: str) -> str | None:
    """What is wrong with a ZeroMQ address to bind; None if nothing is."""
    if endpoint.startswith("ipc://"):
        size = len(endpoint.removeprefix("ipc://").encode(errors="replace"))
        return None if 0 < size <= IPC_PATH_MAX else f"must have a path of 1 to {IPC_PATH_MAX} bytes"
    match = _TCP.fullmatch(endpoint)
    if match is None or (match[2] != "*" and int(match[2]) > _PORT_MAX):
        return "must be tcp://HOST:PORT, port 0 to 65535 or *, or ipc://PATH; such as tcp://127.0.0.1:5555"
    return None
