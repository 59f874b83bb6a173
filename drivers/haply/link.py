"""The connection with the service on this machine: pages of HTTP, and a WebSocket that never blocks.

The library `websockets` keeps the protocol and no socket of its own (sans I/O), so that one thread does everything and
every wait has an end. Nothing is compressed, and no message may be longer than `MESSAGE_MAX`.
"""

from __future__ import annotations

import io
import re
import select
import socket
import time
from contextlib import suppress
from http.client import HTTPException, HTTPResponse
from typing import Any, Final, cast

import msgspec

from softfinger.config.errors import DeviceError, DeviceLost, DeviceNotFound, DeviceTimeout
from softfinger.drivers.haply.messages import Malformed, excerpt
from softfinger.drivers.haply.options import OLD_FORMAT_PORT

HOST: Final = "localhost"
START: Final = "sudo systemctl start haply-inverse-service, or open the Haply Hub"
MESSAGE_MAX: Final = 262_144
"""Bytes; an inventory has some 2000 for each device."""
CHUNK: Final = 65536
_LENGTH: Final = re.compile(rb"\r\ncontent-length: *(\d{1,9})\r\n", re.IGNORECASE)


def remaining(until: float) -> float:
    """Time (s) that is left until a time of the monotonic clock; DeviceTimeout where there is none."""
    left = until - time.monotonic()
    if left <= 0.0:
        raise DeviceTimeout(f"the Inverse Service does not answer in time: restart it ({START})")
    return left


def dial(port: int, until: float) -> socket.socket:
    """A connection with the service. Raises DeviceNotFound, DeviceTimeout, DeviceError."""
    try:
        end = socket.create_connection((HOST, port), timeout=remaining(until))
    except ConnectionRefusedError:
        raise DeviceNotFound(f"no Inverse Service on port {port} of this machine{_old(port)}: {START}") from None
    except TimeoutError:
        raise DeviceTimeout(f"the Inverse Service on port {port} takes no connection: restart it ({START})") from None
    except OSError as error:
        raise DeviceError(f"the Inverse Service on port {port} cannot be reached: {error}") from error
    end.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return end


def ask(port: int, method: str, path: str, body: Any, until: float) -> tuple[int, bytes]:
    """Status and body of a page; `body` (None: none) is sent as JSON. Raises DeviceError and its kinds."""
    content = b"" if body is None else msgspec.json.encode(body)
    head = (
        f"{method} {path} HTTP/1.1\r\nHost: {HOST}:{port}\r\nConnection: close\r\n"
        f"Content-Type: application/json\r\nContent-Length: {len(content)}\r\n\r\n"
    )
    got = bytearray()
    try:
        with dial(port, until) as end:
            end.sendall(head.encode() + content)
            while not _whole(got):
                end.settimeout(remaining(until))
                part = end.recv(CHUNK)
                if not part:
                    break
                got += part
                if len(got) > MESSAGE_MAX:
                    raise DeviceError(f"{method} {path}: the service's answer has more than {MESSAGE_MAX} bytes")
        response = HTTPResponse(cast(socket.socket, _Got(bytes(got))), method=method)
        response.begin()
        return response.status, response.read()
    except TimeoutError:
        raise DeviceTimeout(f"{method} {path}: the Inverse Service does not answer in time") from None
    except (OSError, HTTPException) as error:
        raise DeviceError(f"{method} {path}: the service's answer cannot be read: {error!r}") from error


class Link:
    """An open WebSocket, owned by one thread after the other. Raises DeviceError and its kinds while it opens."""

    def __init__(self, port: int, until: float) -> None:
        client, uri = library()
        self._end = dial(port, until)
        self._end.setblocking(False)
        self._part = bytearray()
        self._protocol = client.ClientProtocol(uri.parse_uri(f"ws://{HOST}:{port}"), max_size=MESSAGE_MAX)
        try:
            self._protocol.send_request(self._protocol.connect())
            self._flush()
            self._first = self._opened(until)
        except BaseException:
            self._end.close()
            raise

    def fileno(self) -> int:
        return self._end.fileno()

    def send(self, message: bytes) -> None:
        """Send a text. Raises DeviceLost, DeviceTimeout where the service takes nothing."""
        self._protocol.send_text(message)
        self._flush()

    def receive(self) -> list[bytes]:
        """Whole messages that are here, without waiting. Raises DeviceLost once it is closed, Malformed where what came
        is no WebSocket's, or too long."""
        found, self._first = self._first, []
        try:
            data = self._end.recv(CHUNK)
        except BlockingIOError:
            return found
        except OSError as error:
            raise DeviceLost(f"the connection with the Inverse Service broke: {error.strerror or error}") from error
        return found + self._taken(data)

    def next(self, until: float) -> bytes:
        """The next message, waited for."""
        while not (found := self.receive()):
            select.select([self._end], [], [], remaining(until))
        self._first = found[1:]
        return found[0]

    def close(self) -> None:
        """Say so, and close. Any number of times."""
        with suppress(Exception):  # it may be closed already, or never have been open
            self._protocol.send_close(1000)
            self._flush()
        self._end.close()

    def _opened(self, until: float) -> list[bytes]:
        """Wait for the service's consent; the messages that came with it."""
        while True:
            found = self.receive_handshake(until)
            if self._protocol.handshake_exc is not None:
                raise DeviceError(
                    f"what listens on the port is no Inverse Service of 3.1 or later: {self._protocol.handshake_exc}"
                )
            if self._protocol.state.name == "OPEN":
                return found

    def receive_handshake(self, until: float) -> list[bytes]:
        select.select([self._end], [], [], remaining(until))
        try:
            data = self._end.recv(CHUNK)
        except BlockingIOError:
            return []
        except OSError as error:
            raise DeviceLost(f"the Inverse Service closed the connection: {error.strerror or error}") from error
        try:
            return self._taken(data)
        except Malformed as error:
            raise DeviceError(str(error)) from None

    def _taken(self, data: bytes) -> list[bytes]:
        protocol, found = self._protocol, []
        if data:
            protocol.receive_data(data)
        else:
            protocol.receive_eof()
        for event in protocol.events_received():
            if not hasattr(event, "opcode") or event.opcode.name not in ("TEXT", "BINARY", "CONT"):
                continue
            self._part += event.data
            if len(self._part) > MESSAGE_MAX:
                raise Malformed(f"a message of the service has more than {MESSAGE_MAX} bytes")
            if event.fin:
                found.append(bytes(self._part))
                self._part.clear()
        self._flush()
        if protocol.state.name in ("CLOSING", "CLOSED") and protocol.handshake_exc is None:
            if protocol.parser_exc is not None and not isinstance(protocol.parser_exc, EOFError):
                raise Malformed(f"the service's WebSocket: {protocol.parser_exc}: {excerpt(data)}")
            raise DeviceLost("the Inverse Service closed the connection: was it stopped or restarted?")
        return found

    def _flush(self) -> None:
        for data in self._protocol.data_to_send():
            if not data:
                continue
            try:
                if self._end.send(data) == len(data):
                    continue
            except BlockingIOError:
                pass
            except OSError as error:
                raise DeviceLost(f"the connection with the Inverse Service broke: {error.strerror or error}") from error
            raise DeviceTimeout("the Inverse Service takes no message: restart it")


class _Got:
    """A page as `HTTPResponse` reads it."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def makefile(self, _mode: str) -> io.BytesIO:
        return io.BytesIO(self._data)


def _whole(got: bytearray) -> bool:
    head, found, body = got.partition(b"\r\n\r\n")
    length = _LENGTH.search(head + b"\r\n") if found else None
    return length is not None and len(body) >= int(length[1])


def _old(port: int) -> str:
    """What is said where a service of the old format runs."""
    try:
        socket.create_connection((HOST, OLD_FORMAT_PORT), timeout=0.2).close()
    except OSError:
        return ""
    return f", but one on port {OLD_FORMAT_PORT}: a service of 3.0, whose format is not public, has to be updated"


def library() -> tuple[Any, Any]:
    """Modules `client` and `uri` of websockets; DeviceError where it is not installed."""
    try:
        from websockets import client, uri
    except ImportError as error:
        raise DeviceError(f"driver haply needs websockets ({error}): pip install 'softfinger[haply]'") from error
    return client, uri
