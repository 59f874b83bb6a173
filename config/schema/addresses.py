"""ZeroMQ addresses of a daemon: validity, exposure to the network, and the default address for commands."""

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
"""Largest length of the path of a Unix socket, bytes."""


COMMANDS_SUFFIX: Final = ".commands"
"""Suffix of the name of a command socket, after the port or the path of the telemetry."""


def find_runtime_folder() -> Path:
    """Return the runtime folder of this user, which need not exist.

    It is `softfinger` in $XDG_RUNTIME_DIR or, if that is not set, a folder of this user in the temporary directory.
    """
    folder = os.environ.get("XDG_RUNTIME_DIR", "")
    if folder.startswith("/"):
        return Path(folder) / "softfinger"
    return Path(tempfile.gettempdir()) / f"softfinger-{os.geteuid()}"


def make_commands_address(telemetry: str) -> str:
    """Return the default address for commands of a daemon with this telemetry address.

    The default is a socket that only this user can reach: for a path, the path with .commands appended; for a port on
    loopback, a socket in the user's runtime folder named by the port. If the telemetry is open to the network, it is
    the next port, with access by key as for the telemetry.
    """
    if telemetry.startswith("ipc://"):
        return f"{telemetry}{COMMANDS_SUFFIX}"
    host, _, port = telemetry.rpartition(":")
    if not is_public(telemetry):
        return f"ipc://{find_runtime_folder()}/{port}{COMMANDS_SUFFIX}"
    if not port.isdecimal() or port == "0":
        return telemetry
    return f"{host}:{int(port) + (1 if int(port) < _PORT_MAX else -1)}"


def make_telemetry_address(endpoint: str) -> str:
    """Return the telemetry address for a default command socket; any other address is returned unchanged."""
    if not endpoint.startswith("ipc://") or not endpoint.endswith(COMMANDS_SUFFIX):
        return endpoint
    path = Path(endpoint.removeprefix("ipc://").removesuffix(COMMANDS_SUFFIX))
    return f"tcp://127.0.0.1:{path.name}" if path.parent == find_runtime_folder() else f"ipc://{path}"


def is_public(endpoint: str) -> bool:
    """Return whether other machines can reach a socket bound to a valid endpoint."""
    match = _TCP.fullmatch(endpoint)
    return match is not None and not _LOOPBACK.fullmatch(match[1])


def check_endpoint(endpoint: str) -> str | None:
    """Return the fault of a ZeroMQ address to bind; None if it is valid."""
    if endpoint.startswith("ipc://"):
        try:
            size = len(endpoint.removeprefix("ipc://").encode())
        except UnicodeEncodeError:
            return "must have a path in UTF-8"
        return None if 0 < size <= IPC_PATH_MAX else f"must have a path of 1 to {IPC_PATH_MAX} bytes"
    match = _TCP.fullmatch(endpoint)
    if match is None or (match[2] != "*" and int(match[2]) > _PORT_MAX):
        return "must be tcp://HOST:PORT, port 0 to 65535 or *, or ipc://PATH; such as tcp://127.0.0.1:5555"
    return None
