"""What the daemon tells its publisher at the start, and what each of the two says to the other afterwards."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from msgspec import Struct

PERIOD_S: Final = 0.1
"""How often the publisher looks after what does not wake it, and tells its figures."""
REQUEST_MAX: Final = 262144
"""Longest frame of a peer that asks, bytes: a scene of 256 objects has some 130 KB."""
ANSWER_MAX: Final = 1 << 22
"""Longest that the daemon says at once, bytes: the triangles of a mesh have 1 MB."""


class Kind(IntEnum):
    """Of a message on the channel."""

    # From the daemon; the first is SETUP.
    SETUP = 1
    SHOWN = 2
    MESSAGE = 3
    """Of a topic, the key, to be published behind the ticks that are there."""
    RETAINED = 4
    """The same, and the newest of its topic is for whoever subscribes later."""
    GREETING = 5
    """Only for whoever subscribes later."""
    ANSWER = 6
    """To a client, the key, whose place is free again."""
    LATER = 7
    """A request was taken, and is answered with LATE: its place is free again."""
    LATE = 8
    END = 9

    # From the publisher.
    READY = 16
    FIGURES = 17
    REQUEST = 18
    """Of a client, the key."""
    TOO_MUCH = 19
    """The same, of one that asks too often."""
    MALFORMED = 20
    """A message of a client that has not two frames."""
    SAID = 21
    """A warning for the log."""


class Entrance(Struct, frozen=True):
    """A socket that listens, where peers come in.

    name    telemetry or commands
    fd      of the socket
    key     file of the secret key, '' where none is needed
    folder  public keys of those who may come in
    """

    name: str
    endpoint: str
    fd: int
    key: str
    folder: str


class Shown(Struct, frozen=True):
    """What `state` says beside the tick: name of the scene; ticks a second, 1/s; the epoch's offset to
    CLOCK_MONOTONIC, s."""

    scene: str = "unnamed"
    rate_hz: float = 1000.0
    epoch_s: float = 0.0


class Ticks(Struct, frozen=True):
    """How ticks are published.

    schema  version of the protocol
    every   one of so many is sent
    topics  of each finger's
    state   the topic of `state`, and how often it is sent, 1/s
    """

    schema: int
    every: int
    topics: list[str]
    state: str
    state_hz: float


class Setup(Struct, frozen=True):
    """Everything that the publisher needs.

    memory   file of the ticks; begin: the row to begin with
    bell     eventfd that is rung when there is a new one
    switch   file of the words that take the force off (`brake.py`)
    backlog  messages kept for a subscriber that falls behind
    priority of SCHED_FIFO that it asks for; 0: for none
    """

    memory: int
    begin: int
    bell: int
    switch: int
    backlog: int
    priority: int
    ticks: Ticks
    shown: Shown
    entrances: list[Entrance]


class Figures(Struct, frozen=True):
    """What the publisher counts, since it was started.

    subscribers  connections of subscribers, now
    lost         messages at which a subscriber was found to be too slow
    refused      connections that were refused
    missed       ticks that were overwritten before it had read them
    """

    subscribers: int = 0
    lost: int = 0
    refused: int = 0
    missed: int = 0
