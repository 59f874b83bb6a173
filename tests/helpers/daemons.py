"""Daemons that replay a shipped recording, and their subscribers."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Final

import numpy as np
import zmq

from helpers.waits import WAIT_S
from softfinger.config.load import load_rig, load_scene
from softfinger.proxy.record import AT
from softfinger.server.app import Daemon
from softfinger.server.services.records import Sink

QUIET: Final = {"telemetry.endpoint": "tcp://127.0.0.1:*", "servo.realtime": "off"}
"""Keys of a rig whose port the system chooses, without real time."""


def make_daemon(
    ticks: int | None = None, scene: str = "paper-plane", changes: Mapping[str, Any] | None = None, **options: Any
) -> Daemon:
    """Return a daemon, not started, that replays the shipped recording; `changes` are those of the rig."""
    return Daemon(load_rig("replay", QUIET | dict(changes or {})), load_scene(scene), ticks, **options)


class RecordSink:
    def __init__(self) -> None:
        self.batches: list[np.ndarray] = []
        self.sink = Sink("records", lambda records, drops: self.batches.append(records.copy()))

    @property
    def all(self) -> np.ndarray:
        return np.concatenate(self.batches)

    @property
    def force(self) -> np.ndarray:
        """Force (3,) N of the last tick; zero before the first."""
        return self.batches[-1][-1, AT.force : AT.force + 3] if self.batches else np.zeros(3)

    def since(self, tick: int) -> np.ndarray:
        """Return the records from a tick on."""
        rows = self.all
        return rows[rows[:, AT.tick] >= tick]


@contextmanager
def subscribed(endpoint: str, *topics: str | bytes, wait_s: float = WAIT_S) -> Iterator[zmq.Socket[bytes]]:
    """Connect a subscriber that uses only pyzmq."""
    with zmq.Context() as context, context.socket(zmq.SUB) as socket:
        socket.linger, socket.rcvhwm, socket.rcvtimeo = 0, 0, round(1000 * wait_s)
        for topic in topics:
            socket.subscribe(topic)
        socket.connect(endpoint)
        yield socket
