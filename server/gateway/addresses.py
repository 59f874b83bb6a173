"""Where a daemon publishes and where it takes commands, found from either of its two addresses."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import cycle
from pathlib import Path
from typing import Any, Final, NamedTuple

from softfinger.config.errors import CommandRefused, ConfigError
from softfinger.config.schema import BESIDE, commands_beside, is_public, telemetry_of
from softfinger.server.keys import ClientKeys
from softfinger.server.wire.asking import NoAnswer
from softfinger.server.wire.client import subscribe
from softfinger.server.wire.control import Control
from softfinger.server.wire.protocol import SCHEMA_TOPIC, ProtocolError

EXPECTED_S: Final = 0.5
"""Time of a turn to ask, first for what an address is expected to be. A daemon answers within milliseconds."""
BUSY_S: Final = 10.0
"""Time that it has to be either, where nobody says another."""


class Addresses(NamedTuple):
    """Endpoints of one daemon; `commands` is None where it takes none."""

    telemetry: str
    commands: str | None

    def commanded(self) -> str:
        """Where to command it; ConfigError where it takes no commands."""
        if self.commands is None:
            raise ConfigError(f"the daemon that publishes on {self.telemetry} takes no commands: its rig has them off")
        return self.commands


def addresses_of(
    endpoint: str,
    keys: ClientKeys | None = None,
    commands: str | None = None,
    *,
    to_command: bool = False,
    within_s: float = BUSY_S,
) -> Addresses:
    """Both addresses of the daemon of which `endpoint` is one.

    commands    where it takes them, if that is known: nothing is sought then
    to_command  whether `endpoint` is more likely that of commands
    within_s    how long the daemon is asked, where anything listens there at all; the machine may be busy

    Where the rig does not say, commands are beside the telemetry (`commands_beside`), and so they are for an address
    that other machines reach. Else the daemon is asked. One that does not answer, since it is not there yet, has the
    commands where a rig has them that does not say.
    """
    if commands is not None:
        return Addresses(telemetry_of(endpoint), commands)
    if endpoint.startswith("ipc://") and endpoint.endswith(BESIDE):
        return _answered([_commanded], endpoint, keys, within_s) or Addresses(telemetry_of(endpoint), endpoint)
    beside = commands_beside(endpoint)
    if beside.startswith("ipc://") and Path(beside.removeprefix("ipc://")).is_socket():
        return Addresses(endpoint, beside)
    likely = Addresses(endpoint, endpoint if to_command else beside)
    if is_public(endpoint):
        return likely
    asks = [_commanded, _published] if to_command else [_published, _commanded]
    return _answered(asks, endpoint, keys, within_s) or likely


def _answered(
    asks: Sequence[Callable[[str, ClientKeys | None, float], Addresses | None]],
    endpoint: str,
    keys: ClientKeys | None,
    within_s: float,
) -> Addresses | None:
    """What the first of the ways to ask finds that has an answer; each has its turns while anything listens."""
    until = time.monotonic() + within_s
    for ask in cycle(asks):
        if (found := ask(endpoint, keys, min(EXPECTED_S, within_s))) is not None:
            return found
        if time.monotonic() > until or not _listens(endpoint):
            return None
    return None


def _published(endpoint: str, keys: ClientKeys | None, wait_s: float) -> Addresses | None:
    """Both, where an endpoint is that of the telemetry: its first message says where the commands are."""
    with subscribe(endpoint, (SCHEMA_TOPIC,), keys=keys) as samples, suppress(ProtocolError):
        if (sample := samples.receive(wait_s)) is not None:
            return Addresses(endpoint, sample.data.get("commands", commands_beside(endpoint)) or None)
    return None


def _commanded(endpoint: str, keys: ClientKeys | None, wait_s: float) -> Addresses | None:
    """Both, where an endpoint is that of commands: the daemon describes itself."""
    with Control(endpoint, wait_s, keys) as control, suppress(NoAnswer, CommandRefused):
        described: dict[str, Any] = control.describe()
        return Addresses(described["endpoints"]["telemetry"], endpoint)
    return None


def _listens(endpoint: str) -> bool:
    """Whether anything does, at an address of this machine; True where that cannot be told."""
    scheme, _, address = endpoint.partition("://")
    host, _, port = address.rpartition(":")
    try:
        if scheme == "ipc":
            with socket.socket(socket.AF_UNIX) as peer:
                peer.connect(address)
        else:
            socket.create_connection((host.strip("[]"), int(port)), EXPECTED_S).close()
    except (ConnectionError, FileNotFoundError):
        return False
    except (OSError, ValueError, OverflowError):
        return True
    return True
