"""Python client of a running daemon: telemetry and commands in one object."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from softfinger.config.arguments import check_text
from softfinger.config.errors import ConfigError
from softfinger.config.schema import make_commands_address, make_telemetry_address
from softfinger.server.gateway.addresses import Addresses, find_addresses
from softfinger.server.wire import DEFAULT_ENDPOINT
from softfinger.server.wire.client import Subscription, Window, subscribe
from softfinger.server.wire.client_requests import R
from softfinger.server.wire.commands import Empty
from softfinger.server.wire.control import Control
from softfinger.server.wire.protocol import CONTACT


class Client(Control):
    """Client of a running daemon: each command of docs/protocol.md is a method; telemetry by `subscribe` or `window`.

    Nothing is sent before the first call. `close` also closes all subscriptions and windows opened by this object. Not
    thread-safe.

    Parameters
    ----------
    telemetry
        Endpoint of the telemetry, as printed by the daemon at its start; or that of the commands.
    commands
        Endpoint of the commands; None: derived from `telemetry`; the daemon there must publish this telemetry.
    timeout_s
        Time limit for an answer; None: depends on the command.

    Raises
    ------
    CommandRefused
        If the daemon refuses a command.
    NoAnswer
        If no answer arrives in time.
    ConfigError
        If the derived endpoint belongs to another daemon.
    NoTelemetry
        If no telemetry arrives in time.

    Examples
    --------
    >>> with Client() as daemon:
    ...     change = daemon.set_params({"object.table.material.stiffness_n_per_m": 800.0})
    ...     sample = next(daemon.subscribe(timeout_s=5.0))
    >>> change.changed["object.table.material.stiffness_n_per_m"].after
    800.0
    >>> sample.contact.mode in (0, 1, 2), len(sample["force"])
    (True, 3)
    """

    def __init__(
        self, telemetry: str = DEFAULT_ENDPOINT, commands: str | None = None, *, timeout_s: float | None = None
    ) -> None:
        self.telemetry = make_telemetry_address(check_text(telemetry, "telemetry", DEFAULT_ENDPOINT))
        super().__init__(make_commands_address(self.telemetry) if commands is None else commands, timeout_s)
        self._verified = commands is not None
        self._opened: Final = list[Subscription | Window]()

    def __repr__(self) -> str:
        return f"<Client: telemetry on {self.telemetry}, commands on {self.endpoint}>"

    def _look_up(self) -> Addresses:
        """Look up both endpoints again: the daemon may have been started after this client."""
        addresses = find_addresses(self.telemetry)
        self.telemetry = addresses.telemetry
        return addresses

    def _ask(self, method: str, params: Any, kind: type[R]) -> R:
        if not self._verified:
            if method == "disarm":  # the daemon may be slow to describe itself
                self.post(method)
            if (commands := self._look_up().command_endpoint()) != self.endpoint:
                self._move(commands)
            endpoint = (
                super()._ask("describe", Empty(), dict).get("endpoints", {}).get("telemetry", "an unknown endpoint")
            )
            if _extract_address_part(endpoint) != _extract_address_part(self.telemetry):
                raise ConfigError(
                    f"commands at {self.endpoint} belong to the daemon with telemetry on {endpoint}, not on "
                    f"{self.telemetry}: give its command endpoint, too, which it prints at the start"
                )
            self._verified = True
        return super()._ask(method, params, kind)

    def _open_telemetry(self) -> str:
        return self.telemetry if self._verified else self._look_up().telemetry

    def subscribe(self, topics: Sequence[str] = (CONTACT,), timeout_s: float | None = None) -> Subscription:
        """Return an iterator of messages on `topics` as they arrive; see `softfinger.server.wire.client.subscribe`."""
        subscription = subscribe(self._open_telemetry(), topics, timeout_s)
        self._opened.append(subscription)
        return subscription

    def window(self, samples: int = 1000, finger: str = "") -> Window:
        """Return the latest ticks as arrays: call `window.update`, then `window["force"]` is (m, 3), m <= samples."""
        window = Window(self._open_telemetry(), samples, finger)
        self._opened.append(window)
        return window

    def close(self) -> None:
        """Disconnect from the commands and all telemetry; may be called repeatedly."""
        super().close()
        for opened in self._opened:
            opened.close()


def _extract_address_part(endpoint: str) -> str:
    """Return the part that distinguishes endpoints of one machine: a path or a port."""
    return endpoint if endpoint.startswith("ipc:") else endpoint.rpartition(":")[2]
