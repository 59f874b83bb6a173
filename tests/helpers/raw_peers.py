"""Raw peers of ZeroMQ's sockets: frames and handshakes of ZMTP 3.0, also for programs in other processes."""

import socket
import struct
from urllib.parse import urlsplit

CUT_S = 30.0
"""Longest wait. The servers' own time-outs are 2 s for a ZMTP handshake and 10 s for a browser's."""
GREETING = b"\xff" + bytes(8) + b"\x7f\x03\0NULL" + bytes(48)
"""First bytes of a peer of ZeroMQ."""


def frame(body: bytes, flags: int = 0) -> bytes:
    long = len(body) > 255
    return bytes((flags | 2 * long,)) + (struct.pack(">Q", len(body)) if long else bytes((len(body),))) + body


def make_ready(kind: bytes) -> bytes:
    return frame(b"\x05READY\x0bSocket-Type" + struct.pack(">I", len(kind)) + kind, 4)


def dial(address: str, wait_s: float = CUT_S) -> socket.socket:
    if address.startswith("ipc://"):
        peer = socket.socket(socket.AF_UNIX)
        peer.connect(address.removeprefix("ipc://"))
    else:
        peer = socket.create_connection(("127.0.0.1", urlsplit(address).port or 0), CUT_S)
    peer.settimeout(wait_s)
    return peer


def greet(address: str, kind: bytes, wait_s: float = CUT_S) -> socket.socket:
    """Connect as a socket of this kind. Raises ConnectionError if the server ends the handshake."""
    peer = dial(address, wait_s)
    try:
        peer.sendall(GREETING + make_ready(kind))
        received = b""
        while b"Socket-Type" not in received:  # libzmq rejects peers that continue before its own handshake
            received += (more := peer.recv(1000))
            if not more:
                raise ConnectionError("turned away")
    except OSError:
        peer.close()
        raise
    return peer
