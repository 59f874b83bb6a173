"""Client side of Foxglove's protocol, as far as the tests need it: https://github.com/foxglove/ws-protocol."""

from __future__ import annotations

import base64
import json
import os
import socket
import struct
from collections.abc import Iterator
from typing import Any, Self

TEXT, BINARY = 1, 2


class Viewer:
    """Client that subscribes to every topic of a server on this machine and collects the messages."""

    def __init__(self, port: int) -> None:
        self.topics: dict[str, dict[str, Any]] = {}
        self._subscribed: dict[int, str] = {}
        self._stream = socket.create_connection(("127.0.0.1", port), timeout=60.0)
        key = base64.b64encode(os.urandom(16)).decode()
        lines = [
            "GET / HTTP/1.1", "Host: 127.0.0.1", "Upgrade: websocket", "Connection: Upgrade",
            f"Sec-WebSocket-Key: {key}", "Sec-WebSocket-Version: 13", "Sec-WebSocket-Protocol: foxglove.sdk.v1",
        ]  # fmt: skip
        self._stream.sendall("\r\n".join([*lines, "", ""]).encode())
        answer = b""
        while not answer.endswith(b"\r\n\r\n"):
            answer += self._take(1)
        assert b" 101 " in answer

    def messages(self) -> Iterator[tuple[str, int, bytes]]:
        """Return topic, time (ns) and data of each message."""
        while True:
            kind, data = self._frame()
            if kind == TEXT:
                message = json.loads(data)
                if message["op"] == "advertise":
                    self._subscribe(message["channels"])
            elif kind == BINARY and data[0] == 1:
                number, time_ns = struct.unpack_from("<IQ", data, 1)
                yield self._subscribed[number], time_ns, data[13:]

    def _subscribe(self, channels: list[dict[str, Any]]) -> None:
        wanted = []
        for channel in channels:
            self.topics[channel["topic"]] = channel
            self._subscribed[channel["id"]] = channel["topic"]
            wanted.append({"id": channel["id"], "channelId": channel["id"]})
        data = json.dumps({"op": "subscribe", "subscriptions": wanted}).encode()
        size = bytes([0x80 | len(data)]) if len(data) < 126 else bytes([0x80 | 126]) + struct.pack(">H", len(data))
        self._stream.sendall(bytes([0x80 | TEXT]) + size + bytes(4) + data)  # masked with zeros

    def _frame(self) -> tuple[int, bytes]:
        first, size = self._take(2)
        if size == 126:
            (size,) = struct.unpack(">H", self._take(2))
        elif size == 127:
            (size,) = struct.unpack(">Q", self._take(8))
        return first & 15, self._take(size)

    def _take(self, count: int) -> bytes:
        data = b""
        while len(data) < count:
            part = self._stream.recv(count - len(data))
            assert part, "the server has hung up"
            data += part
        return data

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stream.close()
