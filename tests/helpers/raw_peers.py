"""Peers below ZeroMQ at a ROUTER, five of each kind at a time: `python raw_peers.py tcp://HOST:PORT SECONDS`."""

import contextlib
import socket
import struct
import sys
import threading
import time

import msgpack

from softfinger.server.socket_process.channel_messages import REQUEST_MAX

GREETING = b"\xff" + bytes(8) + b"\x7f\x03\0NULL" + bytes(48)


def frame(body: bytes, flags: int = 0) -> bytes:
    long = len(body) > 255
    return bytes((flags | 2 * long,)) + (struct.pack(">Q", len(body)) if long else bytes((len(body),))) + body


READY = frame(b"\x05READY\x0bSocket-Type\0\0\0\x06DEALER", 4)
ASKED = frame(b"", 1) + frame(msgpack.packb({"command_id": "r", "method": "describe"}))

ATTACKS = {
    "frames without end": lambda n: frame(bytes(60_000), 1) if n else GREETING + READY,
    "a frame of 2^63 bytes": lambda n: GREETING + READY + b"\x02" + struct.pack(">Q", 1 << 62),
    "a request too long": lambda n: GREETING + READY + frame(bytes(REQUEST_MAX + 1)),
    "answers that are not read": lambda n: ASKED * 50 if n else GREETING + READY,
    "pings": lambda n: frame(b"\x04PING\0\0" + bytes(16), 4) * 500 if n else GREETING + READY,
    "another mechanism": lambda n: GREETING.replace(b"NULL", b"CURV"),
    "a subscriber": lambda n: GREETING + frame(b"\x05READY\x0bSocket-Type\0\0\0\x03SUB", 4),
    "no ZMTP": lambda n: b"GET / HTTP/1.1\r\n\r\n" * 100,
    "nothing": lambda n: b"",
}
"""Return the n-th bytes of a connection; none: a pause."""


def attack(name: str, port: int, until: float) -> None:
    while time.monotonic() < until:
        with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), 5.0) as peer:
            peer.settimeout(0.2)
            for number in range(400):
                if time.monotonic() > until:
                    return
                if data := ATTACKS[name](number):
                    peer.sendall(data)
                else:
                    time.sleep(0.02)


def main(endpoint: str, seconds: str) -> None:
    port, until = int(endpoint.rpartition(":")[2]), time.monotonic() + float(seconds)
    threads = [threading.Thread(target=attack, args=(name, port, until)) for name in ATTACKS for _ in range(5)]
    for thread in threads:
        thread.start()
    print("at work", flush=True)
    for thread in threads:
        thread.join()


if __name__ == "__main__":
    main(*sys.argv[1:])
