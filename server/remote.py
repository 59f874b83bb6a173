"""A running daemon from Python: its telemetry and its commands in one object."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from softfinger.config.errors import ConfigError
from softfinger.config.schema import commands_beside, telemetry_of
from softfinger.server.gateway.addresses import Addresses, addresses_of
from softfinger.server.wire.asking import R
from softfinger.server.wire.client import DEFAULT_ENDPOINT, Subscription, Window, subscribe
from softfinger.server.wire.commands import Empty
from softfinger.server.wire.control import Control
from softfinger.server.wire.protocol import CONTACT


class Client(Control):
    """A running daemon: every command of docs/protocol.md is a method, and telemetry comes by `subscribe` or `window`.

    telemetry, commands  endpoints as the daemon's first lines say them; where commands are left out, the one leads to
                         the other, and the daemon there has to be that with this telemetry
    telemetry            may also be that of the commands
    timeout_s            how long to wait for an answer (None: what the command needs)

    Nothing is sent before it is asked for. A command raises CommandRefused where the daemon does not do it, NoAnswer
    where nothing comes in time, ConfigError where another daemon would have got it; telemetry NoTelemetry. What was
    opened here is closed with it. One thread only.

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
        self.telemetry = telemetry_of(telemetry)
        super().__init__(commands_beside(self.telemetry) if commands is None else commands, timeout_s)
        self._met = commands is not None
        self._opened: Final = list[Subscription | Window]()

    def __repr__(self) -> str:
        return f"<Client: telemetry on {self.telemetry}, commands on {self.endpoint}>"

    def _seek(self) -> Addresses:
        """Both addresses, of a daemon that may have been started meanwhile."""
        found = addresses_of(self.telemetry)
        self.telemetry = found.telemetry
        return found

    def _ask(self, method: str, params: Any, kind: type[R]) -> R:
        if not self._met:
            if (commands := self._seek().commanded()) != self.endpoint:
                self._move(commands)
            found = super()._ask("describe", Empty(), dict).get("endpoints", {}).get("telemetry", "an unknown endpoint")
            if _place(found) != _place(self.telemetry):
                raise ConfigError(
                    f"commands at {self.endpoint} are those of the daemon whose telemetry is on {found}, and not on "
                    f"{self.telemetry}: name its commands, too, as its first lines say them"
                )
            self._met = True
        return super()._ask(method, params, kind)

    def _telemetry(self) -> str:
        return self.telemetry if self._met else self._seek().telemetry

    def subscribe(self, topics: Sequence[str] = (CONTACT,), timeout_s: float | None = None) -> Subscription:
        """Messages of `topics` as they arrive, an iterator; see `softfinger.server.wire.client.subscribe`."""
        subscription = subscribe(self._telemetry(), topics, timeout_s)
        self._opened.append(subscription)
        return subscription

    def window(self, samples: int = 1000, finger: str = "") -> Window:
        """The newest ticks as arrays by field: call its `update`, then `window["force"]` is (m, 3), m <= samples."""
        window = Window(self._telemetry(), samples, finger)
        self._opened.append(window)
        return window

    def close(self) -> None:
        """Disconnect from all of it. Any number of times."""
        super().close()
        for opened in self._opened:
            opened.close()


def _place(endpoint: str) -> str:
    """What tells endpoints of one machine apart: a path, or a port."""
    return endpoint if endpoint.startswith("ipc:") else endpoint.rpartition(":")[2]
