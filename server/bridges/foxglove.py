"""A running daemon in Foxglove, live: its own server, with the topics and messages that a recording has."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import AddressInUse, ConfigError
from softfinger.config.schema import Scene
from softfinger.server.recording.writer import Bytes, Times, Topics

PORT: Final = 8765
"""Where Foxglove looks unless it is told otherwise."""
BACKLOG: Final = 8192
"""Messages that wait for a slow viewer, seconds at 1 kHz; beyond, the oldest are dropped."""


class Server:
    """A WebSocket server of Foxglove's, on this machine only; a `Sink` for `Topics`.

    port  0: a free one

    Raises ConfigError where foxglove-sdk is missing, AddressInUse where the port cannot be had.
    """

    def __init__(self, port: int = PORT) -> None:
        try:
            import foxglove
        except ImportError as error:
            raise ConfigError(f"foxglove-sdk is not installed ({error}): pip install 'softfinger[foxglove]'") from error
        self._sdk: Any = foxglove
        self._context = foxglove.Context()
        self._channels: list[Any] = []
        try:
            self._server: Any = foxglove.start_server(
                name="softfinger", port=port, context=self._context, message_backlog_size=BACKLOG
            )
        except Exception as error:  # a FoxgloveError, which is no class of its own
            raise AddressInUse(
                f"Foxglove's server cannot listen on port {port}: {error}: --port 0 takes a free one"
            ) from error

    @property
    def url(self) -> str:
        """What to open in Foxglove."""
        return f"ws://127.0.0.1:{self._server.port}"

    @property
    def app(self) -> str:
        """The same as a link for a browser."""
        return str(self._server.app_url())

    def channel(self, topic: str, schema: str, descriptors: bytes) -> int:
        """Number of a new topic with protobuf messages of this type."""
        known = self._sdk.Schema(name=schema, encoding="protobuf", data=descriptors)
        self._channels.append(
            self._sdk.Channel(topic, schema=known, message_encoding="protobuf", context=self._context)
        )
        return len(self._channels) - 1

    def message(self, channel: int, time_ns: int, data: bytes) -> None:
        """Send one message to whoever wants its topic."""
        self._channels[channel].log(data, log_time=time_ns)

    def block(self, channel: int, times_ns: Times, messages: Bytes, sequences: NDArray[np.int64]) -> None:
        """Send messages (n, size) with their times (n,)."""
        log = self._channels[channel].log
        for time_ns, message in zip(times_ns.tolist(), messages, strict=True):
            log(message.tobytes(), log_time=time_ns)

    def close(self) -> None:
        """Let the viewers go."""
        self._server.stop()


class Shown:
    """Takes what a daemon sends, and sends it on to a server."""

    failed = False

    def __init__(self, server: Server, fingers: Sequence[str], scene: Scene | None) -> None:
        self._fingers, self._topics = list(fingers), Topics(server, fingers, scene)

    def take(self, records: NDArray[np.float64], finger: int) -> None:
        """Records (n, RECORD_SIZE) of a finger, by its place."""
        self._topics.ticks(records, self._fingers[finger])

    def event(self, event: Mapping[str, Any]) -> None:
        """An event's map, as the wire has it."""
        self._topics.event(event)

    def world(self, world: Mapping[str, Any]) -> None:
        """A message of `world`, a map as the wire has it."""
        self._topics.world(world)
