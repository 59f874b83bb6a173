"""Search for the telemetry and command endpoints of a daemon, given either of them."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from itertools import cycle
from pathlib import Path
from typing import Any, Final, NamedTuple

from softfinger.config.errors import CommandRefused, ConfigError
from softfinger.config.schema import COMMANDS_SUFFIX, is_public, make_commands_address, make_telemetry_address
from softfinger.server.keys import ClientKeys
from softfinger.server.wire.client import subscribe
from softfinger.server.wire.client_requests import NoAnswer
from softfinger.server.wire.control import Control
from softfinger.server.wire.protocol import SCHEMA_TOPIC, ProtocolError

ATTEMPT_TIMEOUT_S: Final = 0.5
"""Duration of one attempt; the first one assumes the expected kind of endpoint. A daemon answers in milliseconds."""
SEARCH_TIMEOUT_S: Final = 10.0
"""Default time after which the search ends."""


class Addresses(NamedTuple):
    """Endpoints of one daemon; `commands` is None if it accepts none."""

    telemetry: str
    commands: str | None

    def command_endpoint(self) -> str:
        """Return the command endpoint; raises ConfigError if there is none."""
        if self.commands is None:
            raise ConfigError(
                f"the daemon that publishes on {self.telemetry} accepts no commands: they are off in its rig"
            )
        return self.commands


def find_addresses(
    endpoint: str,
    keys: ClientKeys | None = None,
    commands: str | None = None,
    *,
    to_command: bool = False,
    within_s: float = SEARCH_TIMEOUT_S,
) -> Addresses:
    """Return both addresses of the daemon that has the address `endpoint`.

    commands    the command endpoint, if it is known: then nothing is searched
    to_command  whether `endpoint` is more likely the command endpoint
    within_s    time limit of the search if something listens at the address; the machine may be busy

    By default, and for an address that other machines can reach, the command endpoint follows from the telemetry
    endpoint (`make_commands_address`). Otherwise the daemon is queried. If it does not answer, for
    example because it has not started yet, the default is returned.
    """
    if commands is not None:
        return Addresses(make_telemetry_address(endpoint), commands)
    if endpoint.startswith("ipc://") and endpoint.endswith(COMMANDS_SUFFIX):
        return _find_first_answer([_query_commands], endpoint, keys, within_s) or Addresses(
            make_telemetry_address(endpoint), endpoint
        )
    neighbour = make_commands_address(endpoint)
    if neighbour.startswith("ipc://") and Path(neighbour.removeprefix("ipc://")).is_socket():
        return Addresses(endpoint, neighbour)
    suggestion = Addresses(endpoint, endpoint if to_command else neighbour)
    if is_public(endpoint):
        return suggestion
    queries = [_query_commands, _query_telemetry] if to_command else [_query_telemetry, _query_commands]
    return _find_first_answer(queries, endpoint, keys, within_s) or suggestion


def _find_first_answer(
    queries: Sequence[Callable[[str, ClientKeys | None, float], Addresses | None]],
    endpoint: str,
    keys: ClientKeys | None,
    within_s: float,
) -> Addresses | None:
    """Return the first result of the queries, which take turns as long as something listens; None without a result."""
    until = time.monotonic() + within_s
    for query in cycle(queries):
        if (announced := query(endpoint, keys, min(ATTEMPT_TIMEOUT_S, within_s))) is not None:
            return announced
        if time.monotonic() > until or not _is_listening(endpoint):
            return None
    return None


def _query_telemetry(endpoint: str, keys: ClientKeys | None, wait_s: float) -> Addresses | None:
    """Return both addresses if an endpoint is telemetry: its first message has the command endpoint."""
    with subscribe(endpoint, (SCHEMA_TOPIC,), keys=keys) as samples, suppress(ProtocolError):
        if (sample := samples.receive(wait_s)) is not None:
            return Addresses(endpoint, sample.data.get("commands", make_commands_address(endpoint)) or None)
    return None


def _query_commands(endpoint: str, keys: ClientKeys | None, wait_s: float) -> Addresses | None:
    """Return both addresses if an endpoint takes commands: the daemon describes itself."""
    with Control(endpoint, wait_s, keys) as control, suppress(NoAnswer, CommandRefused):
        described: dict[str, Any] = control.describe()
        return Addresses(described["endpoints"]["telemetry"], endpoint)
    return None


def _is_listening(endpoint: str) -> bool:
    """Return whether a process listens at an address of this machine; True if that is unknown."""
    scheme, _, address = endpoint.partition("://")
    host, _, port = address.rpartition(":")
    try:
        if scheme == "ipc":
            with socket.socket(socket.AF_UNIX) as peer:
                peer.connect(address)
        else:
            socket.create_connection((host.strip("[]"), int(port)), ATTEMPT_TIMEOUT_S).close()
    except (ConnectionError, FileNotFoundError):
        return False
    except (OSError, ValueError, OverflowError):
        return True
    return True
