"""Where peers come in: the endpoints of a rig, bound before anything else starts, so that faults are told at once.

The publisher has what listens, and so has the daemon: should the one end, peers wait in the system's queue for the
next.
"""

from __future__ import annotations

import os
import tempfile
from contextlib import ExitStack
from typing import Final

from softfinger.config import schema
from softfinger.config.schema import commands_beside, is_public
from softfinger.server.publishing.setup import Entrance
from softfinger.server.wire.endpoint import listen

TELEMETRY: Final = "telemetry"
COMMANDS: Final = "commands"


class Doors:
    """Endpoints that are bound. `close` frees them; until then `entrances` are the publisher's.

    Of an endpoint that is open to the network there are two: that one, where keys are asked for, and another in a
    folder of this user alone, for programs beside the daemon.
    """

    def __init__(self) -> None:
        self.files: Final = ExitStack()
        self.entrances: Final[list[Entrance]] = []
        self.telemetry = ""
        """Where programs of this user find the telemetry."""
        self.commands: str | None = None
        """The same of commands; None: there are none."""
        self.public: Final[dict[str, str]] = {}
        """Endpoints that other machines reach, by the name of their table."""

    @property
    def commands_told(self) -> str:
        """Where telemetry says that commands are taken: the endpoint that other machines reach, if there is one; empty
        where none are taken."""
        return self.public.get(COMMANDS, self.commands or "")

    def close(self) -> None:
        """Any number of times."""
        self.files.close()

    def open(self, name: str, endpoint: str, own: bool = False, keys: tuple[str, str] | None = None) -> str:
        """Bind one; returns it with the port that was chosen. `keys`: the server's secret one, and the folder of those
        who may come in. Raises as `listen`."""
        bound = listen(endpoint, f"[{name}] endpoint", public=keys is not None, own=own)
        self.files.enter_context(bound.files)
        self.entrances.append(Entrance(name, bound.endpoint, bound.fd, *(keys or ("", ""))))
        if keys is not None:
            self.public[name] = bound.endpoint
        return bound.endpoint


def door(endpoint: str) -> Doors:
    """Telemetry alone, on one endpoint that is not open to the network. Raises as `listen`."""
    doors = Doors()
    doors.telemetry = doors.open(TELEMETRY, endpoint)
    return doors


def doors_of(rig: schema.Rig) -> Doors:
    """The endpoints of a rig. Raises ConfigError for keys that cannot be used, AddressInUse and ConfigError as
    `listen`; nothing stays open then."""
    doors, telemetry, commands = Doors(), rig.telemetry.endpoint, rig.commands_endpoint
    with ExitStack() as undo:
        undo.callback(doors.close)
        keys = _keys(rig)
        folder = ""
        if is_public(telemetry) or is_public(commands or ""):
            folder = doors.files.enter_context(_private_folder())
        if is_public(telemetry):
            doors.open(TELEMETRY, telemetry, keys=keys[TELEMETRY])
            telemetry = f"ipc://{folder}/{TELEMETRY}"
        if commands is not None and is_public(commands):
            doors.open(COMMANDS, commands, keys=keys[COMMANDS])
            commands = f"ipc://{folder}/{COMMANDS}"
        doors.telemetry = doors.open(TELEMETRY, telemetry)
        if commands is not None:
            beside = rig.commands.endpoint is None and COMMANDS not in doors.public
            # The port that the telemetry got, where the rig leaves it open.
            place = commands_beside(doors.telemetry) if beside else commands
            doors.commands = doors.open(COMMANDS, place, own=beside)
        undo.pop_all()
    return doors


def _keys(rig: schema.Rig) -> dict[str, tuple[str, str]]:
    """Secret key, and folder of public ones, for each table."""
    if not (is_public(rig.telemetry.endpoint) or is_public(rig.commands_endpoint or "")):
        return {}
    from softfinger.server.gateway.allowed import key_folders  # and with it libzmq, which takes time

    assert rig.security is not None  # else these endpoints are faults of the rig
    readers, commanders = key_folders(rig.security)
    return {TELEMETRY: (rig.security.key, readers), COMMANDS: (rig.security.key, commanders)}


def _private_folder() -> tempfile.TemporaryDirectory[str]:
    """A folder that only this user may enter."""
    runtime = os.environ.get("XDG_RUNTIME_DIR", "")
    return tempfile.TemporaryDirectory(prefix="softfinger-", dir=runtime if os.path.isdir(runtime) else None)
