"""Synthetic records for the telemetry tests, in the layout of the servo."""

import msgpack
import numpy as np

from softfinger.proxy.record import FIELDS, NAMED, RECORD_SIZE


def synthetic(count, first_tick=0, rate_hz=1000.0, start_s=1_700_000_000.0, seed=1):
    """Return records of consecutive ticks, shape (count, RECORD_SIZE), without contact; all floats differ."""
    rows = np.random.default_rng(seed).normal(size=(count, RECORD_SIZE))
    for field in FIELDS:
        if field.kind == "int":
            rows[:, field.at] = 0
    tick = first_tick + np.arange(count)
    put(rows, "tick", tick)
    put(rows, "timestamp", start_s + tick / rate_hz)
    put(rows, "dt", 1.0 / rate_hz)
    put(rows, "contact.object", -1)
    return rows


def put(rows, name, value):
    """Set a field of all rows to one value, or to one value a row."""
    at, size = NAMED[name].at, NAMED[name].size
    rows[:, at if size == 1 else slice(at, at + size)] = value


def join(publisher, *sockets):
    """Publish events until every plain SUB socket (subscribed to `event` too) receives one, then empty the sockets.

    A subscription takes effect some time after connect; earlier messages are not delivered to it.
    """
    for socket in sockets:
        while not (socket.poll(20) and socket.recv_multipart()[0] == b"event"):
            publisher.event("test", "joined")
    publisher.event("test", "all here")
    for socket in sockets:
        while msgpack.unpackb(socket.recv_multipart()[1]).get("name") != "all here":
            pass
