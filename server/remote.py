"""A running daemon from Python: its telemetry and its commands in one object."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from softfinger.server.wire.client import DEFAULT_ENDPOINT, Subscription, Window, subscribe
from softfinger.server.wire.control import DEFAULT_COMMANDS, Control
from softfinger.server.wire.protocol import CONTACT


class Client(Control):
    """A running daemon: every command of docs/protocol.md is a method, and telemetry comes by `subscribe` or `window`.

    telemetry, commands  endpoints as the daemon's first lines say them
    timeout_s            how long to wait for an answer (None: what the command needs)

    Nothing is sent before it is asked for. A command raises CommandRefused where the daemon does not do it, NoAnswer
    where nothing comes in time; telemetry NoTelemetry. What was opened here is closed with it. One thread only.

    >>> with Client() as daemon:
    ...     change = daemon.set_params({"object.table.material.stiffness_n_per_m": 800.0})
    ...     sample = next(daemon.subscribe(timeout_s=5.0))
    >>> change.changed["object.table.material.stiffness_n_per_m"].after
    800.0
    >>> sample.contact.mode in (0, 1, 2), len(sample["force"])
    (True, 3)
    """

    def __init__(
        self, telemetry: str = DEFAULT_ENDPOINT, commands: str = DEFAULT_COMMANDS, timeout_s: float | None = None
    ) -> None:
        super().__init__(commands, timeout_s)
        self.telemetry: Final = telemetry
        self._opened: Final = list[Subscription | Window]()

    def subscribe(self, topics: Sequence[str] = (CONTACT,), timeout_s: float | None = None) -> Subscription:
        """Messages of `topics` as they arrive, an iterator; see `softfinger.server.wire.client.subscribe`."""
        subscription = subscribe(self.telemetry, topics, timeout_s)
        self._opened.append(subscription)
        return subscription

    def window(self, samples: int = 1000, finger: str = "") -> Window:
        """The newest ticks as arrays by field: call its `update`, then `window["force"]` is (m, 3), m <= samples."""
        window = Window(self.telemetry, samples, finger)
        self._opened.append(window)
        return window

    def close(self) -> None:
        """Disconnect from all of it. Any number of times."""
        super().close()
        for opened in self._opened:
            opened.close()
