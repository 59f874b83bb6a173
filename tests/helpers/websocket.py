"""Client side of Foxglove's protocol, as far as the tests need it: https://github.com/foxglove/ws-protocol."""

import json
import struct
from collections.abc import Iterator
from contextlib import AbstractContextManager
from typing import Any

from websockets.sync.client import connect
from websockets.typing import Subprotocol


class Viewer(AbstractContextManager[Any]):
    """Client that subscribes to every topic of a server on this machine and collects the messages."""

    def __init__(self, port: int) -> None:
        self.topics: dict[str, dict[str, Any]] = {}
        self._subscribed: dict[int, str] = {}
        self._socket = connect(
            f"ws://127.0.0.1:{port}", subprotocols=[Subprotocol("foxglove.sdk.v1")], max_size=None, proxy=None
        )

    def messages(self) -> Iterator[tuple[str, int, bytes]]:
        """Return topic, time (ns) and data of each message."""
        while True:
            data = self._socket.recv(timeout=60.0)
            if isinstance(data, str):
                message = json.loads(data)
                if message["op"] == "advertise":
                    self._subscribe(message["channels"])
            elif data[0] == 1:
                number, time_ns = struct.unpack_from("<IQ", data, 1)
                yield self._subscribed[number], time_ns, data[13:]

    def _subscribe(self, channels: list[dict[str, Any]]) -> None:
        wanted = []
        for channel in channels:
            self.topics[channel["topic"]] = channel
            self._subscribed[channel["id"]] = channel["topic"]
            wanted.append({"id": channel["id"], "channelId": channel["id"]})
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def __exit__(self, *_: object) -> None:
        self._socket.close()
