"""Messages between the daemon and its publisher: the setup, and the kinds of all later messages."""

from __future__ import annotations

from enum import IntEnum
from typing import Final

from msgspec import Struct

PERIOD_S: Final = 0.1
"""Interval at which the publisher checks everything that does not wake it, and reports its figures."""
REQUESTS_PERIOD_S: Final = 0.02
"""Interval at which a process of commands reports that it reads requests: a fifth of UNREACHABLE_MAX_S."""
REST_MAX_S: Final = 0.002
"""Longest pause after requests, so that they use at most half of a processor; a `disarm` waits no longer than that."""
REQUEST_MAX: Final = 262144
"""Longest frame of a command client, bytes: a scene of 256 objects has about 130 KB."""
ANSWER_MAX: Final = 1 << 22
"""Longest message of the daemon, bytes: the triangles of a mesh have 1 MB."""


class Kind(IntEnum):
    """Kind of a message on the channel."""

    # From the daemon; SETUP is the first.
    SETUP = 1
    STATE_INFO = 2
    MESSAGE = 3
    """Message to be published on the topic `key`, after the ticks that are available."""
    RETAINED = 4
    """As MESSAGE, and stored for later subscribers as the latest of its topic."""
    GREETING = 5
    """Stored for later subscribers, but not published."""
    ANSWER = 6
    """Answer to the client `key`; frees one of the unanswered requests."""
    DEFERRED = 7
    """A request was accepted and will be answered with DEFERRED_ANSWER; frees one of the unanswered requests."""
    DEFERRED_ANSWER = 8
    END = 9

    # From the publisher.
    READY = 16
    FIGURES = 17
    REQUEST = 18
    """Request of the client `key`; empty for a message without exactly two frames."""
    LOG = 21
    """Warning for the log."""


class ListeningSocket(Struct, frozen=True):
    """Listening socket for peers.

    name      telemetry or commands
    key       file of the secret key, '' if none is required
    folder    public keys of the peers that may connect
    renewals  socket that receives listening sockets for a path that was removed
    """

    name: str
    endpoint: str
    fd: int
    key: str
    folder: str
    renewals: int


class StateInfo(Struct, frozen=True):
    """Contents of `state` that do not come from the tick.

    epoch_s  offset of the epoch from CLOCK_MONOTONIC, s
    """

    scene: str = "unnamed"
    rate_hz: float = 1000.0
    epoch_s: float = 0.0


class TickParameters(Struct, frozen=True):
    """Parameters of the published ticks.

    schema  version of the protocol
    every   one in this many ticks is sent
    """

    schema: int
    every: int
    topics: list[str]
    state: str
    state_hz: float


class ProcessSetup(Struct, frozen=True):
    """Setup of a process; without an endpoint of telemetry it does not send ticks.

    memory    file of the ticks
    bell      eventfd that signals a new row
    switch    file of the force switch (`force_off.py`)
    backlog   messages queued for a slow subscriber
    priority  SCHED_FIFO priority to request; 0 for none
    """

    memory: int
    begin: int
    bell: int
    switch: int
    backlog: int
    priority: int
    ticks: TickParameters
    state_info: StateInfo
    listeners: list[ListeningSocket]


class Figures(Struct, frozen=True):
    """Counters of the publisher since its start.

    subscribers  present connections of subscribers
    lost         messages at which a subscriber was found to be too slow
    missed       ticks that were overwritten before the publisher read them
    """

    subscribers: int = 0
    lost: int = 0
    refused: int = 0
    missed: int = 0
