"""Endpoints of a rig, bound before anything else starts, so that errors are reported at once.

Both the publisher and the daemon have the listening sockets: if the publisher exits, peers wait in the system's queue
for the next one.
"""

from __future__ import annotations

import contextlib
import os
import socket
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack
from typing import Final

from softfinger.config import schema
from softfinger.config.errors import HapticError
from softfinger.config.schema import is_public, make_commands_address
from softfinger.server.socket_process.channel_messages import ListeningSocket
from softfinger.server.wire.endpoint import BoundSocket, listen

TELEMETRY: Final = "telemetry"
COMMANDS: Final = "commands"


class Endpoints:
    """Bound endpoints; `close` frees them, and until then the publisher uses `listeners`.

    For an endpoint that is open to the network there are two: that endpoint, which requires keys, and another one in a
    folder of this user only, for programs on this machine.
    """

    def __init__(self) -> None:
        self.files: Final = ExitStack()
        self.listeners: Final[list[ListeningSocket]] = []
        self.telemetry = ""
        """Telemetry endpoint for programs of this user."""
        self.commands: str | None = None
        """Command endpoint for programs of this user; None if there is none."""
        self._bound: Final[list[tuple[BoundSocket, socket.socket]]] = []
        """Sockets with a file, and the socket to send one that replaces it to its process."""
        self.public: Final[dict[str, str]] = {}
        """Endpoints that other machines can reach, by the name of their table."""

    def close(self) -> None:
        """Free all endpoints; may be called repeatedly."""
        self.files.close()

    def bind(self, name: str, endpoint: str, private: bool = False, keys: tuple[str, str] | None = None) -> str:
        """Bind an endpoint; return it with the chosen port. Raises the errors of `listen`.

        name     telemetry or commands
        private  as for `listen`
        keys     file of the server's secret key, and the folder of the keys of peers that may connect
        """
        bound = listen(endpoint, f"[{name}] endpoint", public=keys is not None, private=private)
        self.files.enter_context(bound.files)
        own_end, child_end = map(self.files.enter_context, socket.socketpair())
        for end in (own_end, child_end):
            end.setblocking(False)
        self._bound.append((bound, own_end))
        self.listeners.append(ListeningSocket(name, bound.endpoint, bound.fd, *(keys or ("", "")), child_end.fileno()))
        if keys is not None:
            self.public[name] = bound.endpoint
        return bound.endpoint

    def rebind(self) -> Iterator[str]:
        """Bind sockets whose files were removed or replaced again, also for their processes; yield their endpoints.

        Raises the last error of `BoundSocket.rebind`, after all others were bound.
        """
        failure: Exception | None = None
        for bound, own_end in self._bound:
            try:
                if not bound.rebind():
                    continue
                with contextlib.suppress(BlockingIOError):  # the process does not read
                    socket.send_fds(own_end, [b"\0"], [bound.fd])
            except (OSError, HapticError) as error:
                failure = error
            else:
                yield bound.endpoint
        if failure is not None:
            raise failure


def bind_telemetry(endpoint: str) -> Endpoints:
    """Bind telemetry only, on one endpoint that is not open to the network; raises the errors of `listen`."""
    endpoints = Endpoints()
    endpoints.telemetry = endpoints.bind(TELEMETRY, endpoint)
    return endpoints


def bind_rig(rig: schema.Rig) -> Endpoints:
    """Bind the endpoints of a rig, all or none; raises ConfigError for unusable keys, and the errors of `listen`."""
    endpoints, telemetry, commands = Endpoints(), rig.telemetry.endpoint, rig.commands_endpoint
    with ExitStack() as undo:
        undo.callback(endpoints.close)
        if is_public(telemetry) or is_public(commands or ""):
            telemetry, commands = _bind_public(endpoints, rig, telemetry, commands)
        endpoints.telemetry = endpoints.bind(TELEMETRY, telemetry)
        if commands is not None:
            is_beside = rig.commands.endpoint is None and COMMANDS not in endpoints.public
            # The port chosen for the telemetry, if the rig does not set one.
            commands_endpoint = make_commands_address(endpoints.telemetry) if is_beside else commands
            endpoints.commands = endpoints.bind(COMMANDS, commands_endpoint, private=is_beside)
        undo.pop_all()
    return endpoints


def _bind_public(endpoints: Endpoints, rig: schema.Rig, telemetry: str, commands: str | None) -> tuple[str, str | None]:
    """Bind the endpoints that are open to the network; return those for programs of this user."""
    from softfinger.server.socket_process.allowed import list_key_folders  # imports libzmq, which takes time

    assert rig.security is not None  # the rig is refused without it
    key, (readers, commanders) = rig.security.key, list_key_folders(rig.security)
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    folder = endpoints.files.enter_context(
        tempfile.TemporaryDirectory(prefix="softfinger-", dir=runtime if os.path.isdir(runtime) else None)
    )
    if is_public(telemetry):
        endpoints.bind(TELEMETRY, telemetry, keys=(key, readers))
        telemetry = f"ipc://{folder}/{TELEMETRY}"
    if commands is not None and is_public(commands):
        endpoints.bind(COMMANDS, commands, keys=(key, commanders))
        commands = f"ipc://{folder}/{COMMANDS}"
    return telemetry, commands
