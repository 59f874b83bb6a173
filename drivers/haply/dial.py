"""TCP connections to the service on this machine, and HTTP requests over them."""

from __future__ import annotations

import io
import re
import socket
import time
from http.client import HTTPException, HTTPResponse
from typing import Any, Final, cast

import msgspec

from softfinger.config.errors import DeviceError, DeviceNotFound, DeviceTimeout
from softfinger.drivers.haply.options import OLD_FORMAT_PORT

HOST: Final = "localhost"
START: Final = "sudo systemctl start haply-inverse-service, or open the Haply Hub"
MESSAGE_MAX: Final = 262_144
"""Maximum bytes of a message; an inventory has about 2000 per device."""
CHUNK: Final = 65536
SEND_BUFFER: Final = 8192
"""Bytes of the system's send buffer (doubled by Linux): few messages queue here if the service does not read.

The default queues about 26 000 bytes. The size of the service's receive buffer cannot be limited.
"""
_LENGTH: Final = re.compile(rb"\r\ncontent-length: *(\d{1,9})\r\n", re.IGNORECASE)


def check_remaining_time(until: float) -> float:
    """Return the time (s) until `until` (monotonic clock); raises DeviceTimeout if it has passed."""
    remaining_s = until - time.monotonic()
    if remaining_s <= 0.0:
        raise DeviceTimeout(f"the Inverse Service does not answer in time: restart it ({START})")
    return remaining_s


def connect(port: int, until: float) -> socket.socket:
    """Connect to the service. Raises DeviceNotFound, DeviceTimeout, DeviceError."""
    try:
        connection = socket.create_connection((HOST, port), timeout=check_remaining_time(until))
    except ConnectionRefusedError:
        raise DeviceNotFound(
            f"no Inverse Service on port {port} of this machine{_describe_old_service(port)}: {START}"
        ) from None
    except TimeoutError:
        raise DeviceTimeout(f"the Inverse Service on port {port} takes no connection: restart it ({START})") from None
    except OSError as error:
        raise DeviceError(f"the Inverse Service on port {port} cannot be reached: {error}") from error
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
    return connection


def request(port: int, method: str, path: str, body: Any, until: float) -> tuple[int, bytes]:
    """Send a request, with `body` as JSON unless None; return status and body. Raises DeviceError or a subclass."""
    content = b"" if body is None else msgspec.json.encode(body)
    head = (
        f"{method} {path} HTTP/1.1\r\nHost: {HOST}:{port}\r\nConnection: close\r\n"
        f"Content-Type: application/json\r\nContent-Length: {len(content)}\r\n\r\n"
    )
    received = bytearray()
    try:
        with connect(port, until) as connection:
            connection.sendall(head.encode() + content)
            while not _is_complete(received):
                connection.settimeout(check_remaining_time(until))
                part = connection.recv(CHUNK)
                if not part:
                    break
                received += part
                if len(received) > MESSAGE_MAX:
                    raise DeviceError(f"{method} {path}: the service's answer has more than {MESSAGE_MAX} bytes")
        response = HTTPResponse(cast(socket.socket, _Response(bytes(received))), method=method)
        response.begin()
        return response.status, response.read()
    except TimeoutError:
        raise DeviceTimeout(f"{method} {path}: the Inverse Service does not answer in time") from None
    except (OSError, HTTPException) as error:
        raise DeviceError(f"{method} {path}: the service's answer cannot be read: {error!r}") from error


class _Response:
    """Response in memory, with the interface that `HTTPResponse` reads."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def makefile(self, _mode: str) -> io.BytesIO:
        return io.BytesIO(self._data)


def _is_complete(received: bytearray) -> bool:
    head, separator, body = received.partition(b"\r\n\r\n")
    length = _LENGTH.search(head + b"\r\n") if separator else None
    return length is not None and len(body) >= int(length[1])


def _describe_old_service(port: int) -> str:
    """Return an addition to the message if a service of the old format runs."""
    try:
        socket.create_connection((HOST, OLD_FORMAT_PORT), timeout=0.2).close()
    except OSError:
        return ""
    return f", but one on port {OLD_FORMAT_PORT}: a service of 3.0, which this driver does not speak: update it"
