"""Client of the peer's protocol, written from its documentation only: DEALER sockets, an empty frame, a msgpack map.

As documented there, user commands and heartbeats use one socket each, answers are matched by `command_id`, and an
answer has exactly the four documented keys.
"""

import dataclasses
import threading
import time
import uuid
from typing import Any

import msgpack
import zmq


@dataclasses.dataclass
class Response:
    command_id: str
    success: bool
    result: dict[str, Any]
    error: str | None = None


@dataclasses.dataclass
class HapticState:
    timestamp: float
    sequence: int
    position: list[float]
    velocity: list[float]
    force: list[float]
    active_field: str
    field_state: dict[str, Any]


class Client:
    def __init__(self, endpoint: str, heartbeat_s: float = 0.05, timeout_s: float = 20.0) -> None:
        self._timeout_s = timeout_s
        self._context = zmq.Context()
        self._commands, self._heartbeats = (self._dealer(endpoint) for _ in range(2))
        self._shutdown = threading.Event()
        self.beats: list[Response] = []
        self._thread = threading.Thread(target=self._beat, args=(heartbeat_s,))
        self._thread.start()

    def _dealer(self, endpoint: str) -> zmq.Socket[bytes]:
        socket = self._context.socket(zmq.DEALER)
        socket.linger = 0
        socket.connect(endpoint)
        return socket

    def _ask(self, socket: zmq.Socket[bytes], method: str, params: dict[str, Any]) -> Response:
        command_id = uuid.uuid4().hex[:12]
        socket.send_multipart([b"", msgpack.packb({"command_id": command_id, "method": method, "params": params})])
        until = time.monotonic() + self._timeout_s
        while (remaining := until - time.monotonic()) > 0.0 and socket.poll(int(1000 * remaining)):
            empty, body = socket.recv_multipart()
            assert empty == b""
            response = Response(**msgpack.unpackb(body, raw=False))
            if response.command_id == command_id:
                return response
        raise TimeoutError(method)

    def command(self, method: str, **params: Any) -> Response:
        return self._ask(self._commands, method, params)

    def state(self) -> HapticState:
        return HapticState(**self.command("get_state").result)

    def _beat(self, interval_s: float) -> None:
        while not self._shutdown.wait(interval_s):
            self.beats.append(self._ask(self._heartbeats, "heartbeat", {}))

    def close(self) -> None:
        self._shutdown.set()
        self._thread.join()
        self._commands.close()
        self._heartbeats.close()
        self._context.term()
