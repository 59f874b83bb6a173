"""Connections to the service on this machine: HTTP requests, and a WebSocket that never blocks.

`websockets` implements the protocol without a socket (sans I/O), so that one thread does everything and every wait is
limited. There is no compression, and the maximum length of a message is `MESSAGE_MAX`.
"""

from __future__ import annotations

import fcntl
import select
import socket
import struct
import sys
import termios
import time
from http.client import HTTPConnection, HTTPException
from typing import Any, Final

import msgspec

from softfinger.config.errors import DeviceError, DeviceLost, DeviceNotFound, DeviceTimeout
from softfinger.drivers.closeable import undo_on_error
from softfinger.drivers.haply.messages import Malformed, shorten
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
        raise DeviceTimeout(f"the Inverse Service on port {port} accepts no connection: restart it ({START})") from None
    except OSError as error:
        raise DeviceError(f"the Inverse Service on port {port} cannot be reached: {error}") from error
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
    return connection


class _TimedSocket(socket.socket):
    """Connection with one time limit for all reads: a program that sends byte by byte could continue for ever."""

    def __init__(self, connection: socket.socket, until: float) -> None:
        super().__init__(fileno=connection.detach())
        self._until = until

    def recv_into(self, *args: Any) -> int:
        self.settimeout(check_remaining_time(self._until))
        return super().recv_into(*args)


def request(port: int, method: str, path: str, body: Any, until: float) -> tuple[int, bytes]:
    """Send a request, with `body` as JSON unless None; return status and body. Raises DeviceError or a subclass."""
    connection = HTTPConnection(HOST, port)
    connection.sock = _TimedSocket(connect(port, until), until)
    headers = {"Connection": "close", "Content-Type": "application/json"}
    try:
        connection.sock.settimeout(check_remaining_time(until))
        connection.request(method, path, None if body is None else msgspec.json.encode(body), headers)
        response = connection.getresponse()
        answer = response.read(MESSAGE_MAX + 1)
    except TimeoutError:
        raise DeviceTimeout(f"{method} {path}: the Inverse Service does not answer in time") from None
    except (OSError, HTTPException) as error:
        raise DeviceError(f"{method} {path}: the service's answer cannot be read: {error!r}") from error
    finally:
        connection.close()
    if len(answer) > MESSAGE_MAX:
        raise DeviceError(f"{method} {path}: the service's answer has more than {MESSAGE_MAX} bytes")
    return response.status, answer


def _describe_old_service(port: int) -> str:
    """Return an addition to the message if a service of the old format runs."""
    try:
        socket.create_connection((HOST, OLD_FORMAT_PORT), timeout=0.2).close()
    except OSError:
        return ""
    return f", but one on port {OLD_FORMAT_PORT}: a service of 3.0, which this driver does not support: update it"


CLOSE_TIMEOUT_S: Final = 0.2
"""Time for the service to read the last message and close the connection."""


class WebSocketLink:
    """Open WebSocket, used by one thread at a time. Opening raises DeviceError or a subclass."""

    def __init__(self, port: int, until: float) -> None:
        client, uri, self._frames = import_websockets()
        self._end = connect(port, until)
        self._end.setblocking(False)
        self._partial = bytearray()
        self._unsent = bytearray()
        """Bytes not accepted by the system yet: the end of a frame, and the frames after it."""
        self._protocol = client.ClientProtocol(uri.parse_uri(f"ws://{HOST}:{port}"), max_size=MESSAGE_MAX)
        with undo_on_error(self._end.close):
            self._protocol.send_request(self._protocol.connect())
            self._flush()
            self._queued_messages = self._await_handshake(until)

    def fileno(self) -> int:
        return self._end.fileno()

    def send(self, message: bytes) -> None:
        """Send a text message. Raises DeviceLost, or DeviceTimeout if the service does not read."""
        self._protocol.send_text(message)
        self._flush()

    def count_unread_bytes(self) -> int:
        """Return the number of sent bytes that the service's side of the connection has not acknowledged."""
        return int.from_bytes(fcntl.ioctl(self._end, termios.TIOCOUTQ, bytes(4)), sys.byteorder)

    def receive(self) -> list[bytes]:
        """Return the complete messages that have arrived, without waiting.

        Raises DeviceLost if the connection is closed, Malformed if the data violates the protocol or a message is too
        long.
        """
        messages, self._queued_messages = self._queued_messages, []
        try:
            data = self._end.recv(CHUNK)
        except BlockingIOError:
            return messages
        except OSError as error:
            raise DeviceLost(f"the connection to the Inverse Service was lost: {error.strerror or error}") from error
        return messages + self._process_data(data)

    def wait_for_message(self, until: float) -> bytes:
        """Wait for the next message and return it."""
        while not (messages := self.receive()):
            select.select([self._end], [], [], check_remaining_time(until))
        self._queued_messages = messages[1:]
        return messages[0]

    def close(self, last: bytes = b"") -> bool:
        """Send `last` and a Close frame, wait up to `CLOSE_TIMEOUT_S` until the service closes, close the socket.

        `websockets` answers a Close frame or a protocol violation with a Close frame, and accepts no message after it.
        So `last` is framed here and precedes the bytes of the library. If the service does not accept all of it, the
        connection is reset, so that no earlier message in the send buffer is delivered later.

        Returns
        -------
        bool
            True if the service closed the connection: it has read `last`, or its session was over before.
        """
        if self._end.fileno() < 0:
            return True
        frames, protocol = self._frames, self._protocol
        if last:
            self._unsent += frames.Frame(frames.Opcode.TEXT, last).serialize(mask=True)
        if protocol.state.name == "OPEN":
            protocol.send_close(1000)
        self._unsent += b"".join(protocol.data_to_send())
        try:
            closed = self._finish(time.monotonic() + CLOSE_TIMEOUT_S)
        except OSError:  # reset by the service
            closed = True
        self._end.close()
        return closed

    def _finish(self, until: float) -> bool:
        """Send unsent bytes and discard received ones until the service closes; return False if it does not in time."""
        reading = True
        while reading or self._unsent:
            wait = max(until - time.monotonic(), 0.0)
            readable, writable, _ = select.select([self._end] * reading, [self._end] * bool(self._unsent), [], wait)
            if writable:
                del self._unsent[: self._end.send(self._unsent)]
                if not self._unsent:
                    self._end.shutdown(socket.SHUT_WR)
            if readable:  # unread data would turn the close into a reset
                reading = bool(self._end.recv(CHUNK))
            if not wait:
                break
        if self._unsent:
            self._end.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
        return not reading and not self._unsent

    def _await_handshake(self, until: float) -> list[bytes]:
        """Wait until the service accepts the connection; return messages received with the acceptance."""
        while True:
            messages = self.receive_handshake(until)
            if self._protocol.handshake_exc is not None:
                raise DeviceError(
                    f"the program on the port is not an Inverse Service of 3.1 or later: {self._protocol.handshake_exc}"
                )
            if self._protocol.state.name == "OPEN":
                return messages

    def receive_handshake(self, until: float) -> list[bytes]:
        select.select([self._end], [], [], check_remaining_time(until))
        try:
            data = self._end.recv(CHUNK)
        except BlockingIOError:
            return []
        except OSError as error:
            raise DeviceLost(f"the Inverse Service closed the connection: {error.strerror or error}") from error
        try:
            return self._process_data(data)
        except Malformed as error:
            raise DeviceError(str(error)) from None

    def _process_data(self, data: bytes) -> list[bytes]:
        protocol, messages = self._protocol, []
        if data:
            protocol.receive_data(data)
        else:
            protocol.receive_eof()
        for event in protocol.events_received():
            if not hasattr(event, "opcode") or event.opcode.name not in ("TEXT", "BINARY", "CONT"):
                continue
            self._partial += event.data
            if len(self._partial) > MESSAGE_MAX:
                raise Malformed(f"a message of the service has more than {MESSAGE_MAX} bytes")
            if event.fin:
                messages.append(bytes(self._partial))
                self._partial.clear()
        if protocol.state.name in ("CLOSING", "CLOSED") and protocol.handshake_exc is None:
            # The library's Close frame is not sent yet: `close` sends the last message before it.
            if protocol.parser_exc is not None and not isinstance(protocol.parser_exc, EOFError):
                raise Malformed(f"the service's WebSocket: {protocol.parser_exc}: {shorten(data)}")
            raise DeviceLost("the Inverse Service closed the connection: check whether it was stopped or restarted")
        self._flush()
        return messages

    def _flush(self) -> None:
        self._unsent += b"".join(self._protocol.data_to_send())
        try:
            if self._unsent:
                del self._unsent[: self._end.send(self._unsent)]
        except BlockingIOError:
            pass
        except OSError as error:
            raise DeviceLost(f"the connection to the Inverse Service was lost: {error.strerror or error}") from error
        if self._unsent:
            raise DeviceTimeout("the Inverse Service accepts no message: restart it")


def import_websockets() -> tuple[Any, Any, Any]:
    """Return the modules `client`, `uri` and `frames` of websockets; raises DeviceError if it is not installed."""
    try:
        from websockets import client, frames, uri
    except ImportError as error:
        raise DeviceError(f"driver haply needs websockets ({error}): pip install 'softfinger[haply]'") from error
    return client, uri, frames
