"""Live view of a running daemon in Foxglove: a WebSocket server with the topics and messages of a recording."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import AddressInUse, ConfigError
from softfinger.server.options import FOXGLOVE_PORT
from softfinger.server.recording.writer import Bytes, Times

BACKLOG: Final = 8192
"""Queued messages of a slow viewer, seconds at 1 kHz; beyond it, the oldest are dropped."""


class Server:
    """Foxglove's WebSocket server, for this machine only; a `MessageSink` for `Topics`.

    port  0: a free port

    Raises ConfigError if foxglove-sdk is not installed, and AddressInUse if the port is not available.
    """

    def __init__(self, port: int = FOXGLOVE_PORT) -> None:
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
        except Exception as error:  # a FoxgloveError, which is not a separate class
            raise AddressInUse(
                f"Foxglove's server cannot listen on port {port}: {error}: --port 0 selects a free one"
            ) from error

    @property
    def url(self) -> str:
        return f"ws://127.0.0.1:{self._server.port}"

    @property
    def app(self) -> str:
        """Link to the same connection for a browser."""
        return str(self._server.app_url())

    def channel(self, topic: str, schema: str, descriptors: bytes) -> int:
        foxglove_schema = self._sdk.Schema(name=schema, encoding="protobuf", data=descriptors)
        self._channels.append(
            self._sdk.Channel(topic, schema=foxglove_schema, message_encoding="protobuf", context=self._context)
        )
        return len(self._channels) - 1

    def message(self, channel: int, time_ns: int, data: bytes) -> None:
        self._channels[channel].log(data, log_time=time_ns)

    def block(self, channel: int, times_ns: Times, messages: Bytes, sequences: NDArray[np.int64]) -> None:
        """Send messages (n, size) with their times (n,)."""
        log = self._channels[channel].log
        for time_ns, message in zip(times_ns.tolist(), messages, strict=True):
            log(message.tobytes(), log_time=time_ns)

    def close(self) -> None:
        self._server.stop()
