"""The publisher: records in, ZeroMQ messages out, never waiting for a subscriber."""

from __future__ import annotations

import fcntl
import ipaddress
import os
import stat
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np
import zmq
from numpy.typing import NDArray

from softfinger.config.errors import AddressInUse, ConfigError
from softfinger.proxy.state import MODE_NAMES, OFFSET, RECORD_SIZE
from softfinger.server.events import RecordEvents
from softfinger.server.protocol import CONTACT, EVENT, HEALTH, SCHEMA, contact_map, encode, nest

Records = NDArray[np.float64]

BACKLOG: Final = 40960
"""Messages kept for a subscriber that stalls: 5 s at 8 kHz, 41 s and some 30 MB at 1 kHz."""

LINGER_MS: Final = 200
"""How long closing waits for the last messages (the event that says why) to leave."""

HEALTH_PERIOD_S: Final = 1.0
_HEALTH_ROWS: Final = 16384  # a second at the highest rate, twice over
_QUANTILES: Final = {"p50": 50.0, "p99": 99.0, "p999": 99.9, "max": 100.0}

_TICK: Final = OFFSET["tick"]


class Publisher:
    """PUB socket bound to `endpoint`; sends one tick in `every`.

    `publish` belongs to one thread; `event` may be called from any thread, but not from a signal
    handler. After `close` both do nothing. Raises AddressInUse if another process holds the
    endpoint, ConfigError if the endpoint cannot or may not be bound.
    """

    def __init__(
        self,
        endpoint: str,
        every: int = 1,
        context: zmq.Context[zmq.Socket[bytes]] | None = None,
        *,
        guard_names: Sequence[str] = (),
        backlog: int = BACKLOG,
    ) -> None:
        if every < 1:
            raise ConfigError(f"[telemetry] every = {every} is below 1: 1 publishes each tick, 10 one in ten")
        check_endpoint(endpoint)
        self._every = every
        self._context = context or zmq.Context()
        self._own_context = context is None
        self._lock = threading.Lock()
        self._events = RecordEvents(guard_names)
        self._health = Health()
        self._tick = -1
        self._socket = self._context.socket(zmq.PUB)
        self._socket.sndhwm = backlog
        self._socket.linger = 0
        self._lock_file: int | None = None
        try:
            self._lock_file = _bind(self._socket, endpoint)
        except BaseException:
            self.close()
            raise
        self.endpoint = self._socket.get_string(zmq.LAST_ENDPOINT).rstrip("\0")
        """The endpoint as bound: a `*` port is replaced by the one chosen."""

    def publish(self, records: Records, drops: int = 0) -> None:
        """Send a batch of records, shape (n, RECORD_SIZE), and what follows from them.

        `drops` is how many records the ring has lost since the servo started.
        """
        with self._lock:
            if self._socket.closed or not len(records):
                return
            for record in records:
                if self._every == 1 or record[_TICK] % self._every == 0:
                    self._send(CONTACT, contact_map(record, self._every))
            self._tick = int(records[-1, _TICK])
            for event in self._events.observe(records):
                self._send(EVENT, event)
            for health in self._health.add(records, drops):
                self._send(HEALTH, health)

    def event(self, kind: str, name: str, **fields: Any) -> None:
        """Send an event at once; `fields` are further keys, of types msgpack knows."""
        with self._lock:
            if self._socket.closed:
                return
            head = {"schema": SCHEMA, "timestamp": time.time(), "tick": self._tick, "kind": kind, "name": name}
            self._send(EVENT, fields | head)

    def _send(self, topic: str, message: dict[str, Any]) -> None:
        body = encode(message)  # before the first frame leaves: a message is sent whole or not at all
        self._socket.send(topic.encode(), zmq.SNDMORE)
        self._socket.send(body)

    def close(self) -> None:
        """Send what is under way, for at most LINGER_MS, and free the endpoint. Any number of times."""
        with self._lock:
            if self._socket.closed:
                return
            self._socket.close(linger=LINGER_MS)
            if self._own_context:
                self._context.term()
            if self._lock_file is not None:
                os.close(self._lock_file)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def check_endpoint(endpoint: str) -> None:
    """Raise ConfigError unless telemetry may be bound to `endpoint`: loopback tcp, ipc or inproc."""
    scheme, _, address = endpoint.partition("://")
    if scheme in ("ipc", "inproc") and address:
        return
    host, _, port = address.rpartition(":")
    if scheme != "tcp" or not host or not (port == "*" or (port.isdecimal() and int(port) < 65536)):
        raise ConfigError(
            f"[telemetry] endpoint = {endpoint!r} is not an endpoint: "
            "use tcp://127.0.0.1:PORT (0 to 65535, or * for a free one) or ipc:///path/to/socket"
        )
    if not _is_loopback(host):
        raise ConfigError(
            f"[telemetry] endpoint = {endpoint!r} can be reached from other machines, which needs CURVE keys, and none "
            f"are configured: use tcp://127.0.0.1:{port} or an ipc:// path, and reach it through an SSH tunnel"
        )


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host.strip("[]")).is_loopback
    except ValueError:
        return False


def _bind(socket: zmq.Socket[bytes], endpoint: str) -> int | None:
    """Bind; returns the descriptor of the lock file of an ipc path, which holds it until closed."""
    scheme, _, address = endpoint.partition("://")
    path = Path(address) if scheme == "ipc" and address[0] not in "@*" else None
    # ipc: group may connect, others not. The mask belongs to the process, so it is put back at once.
    mask = os.umask(0o117) if scheme == "ipc" else None
    lock_file = None
    try:
        if path is not None:
            lock_file = _claim(path, endpoint)
        socket.ipv6 = "[" in address
        socket.bind(endpoint.replace("//localhost:", "//127.0.0.1:"))
    except zmq.ZMQError as error:
        if lock_file is not None:
            os.close(lock_file)
        if error.errno == zmq.EADDRINUSE:
            raise _in_use(endpoint) from error
        raise ConfigError(f"[telemetry] endpoint = {endpoint!r} cannot be bound: {error}; choose another") from error
    finally:
        if mask is not None:
            os.umask(mask)
    return lock_file


def _claim(path: Path, endpoint: str) -> int:
    """Lock `path`.lock, for ZeroMQ would take an ipc path from its owner, or remove a plain file there, unasked.

    The lock file stays behind: removing it would let two processes lock two files of one name.
    """
    try:
        if path.exists() and not stat.S_ISSOCK(path.stat().st_mode):
            raise ConfigError(f"[telemetry] endpoint = {endpoint!r}: {path} exists and is no socket; choose another")
        lock_file = os.open(f"{path}.lock", os.O_CREAT | os.O_RDWR | os.O_CLOEXEC, 0o660)
    except OSError as error:
        raise ConfigError(
            f"[telemetry] endpoint = {endpoint!r} cannot be bound: {error}; choose a folder that you may write to"
        ) from error
    try:
        fcntl.flock(lock_file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(lock_file)
        raise _in_use(endpoint) from error
    return lock_file


def _in_use(endpoint: str) -> AddressInUse:
    free = "another path" if endpoint.startswith("ipc:") else "another port (tcp://127.0.0.1:* takes a free one)"
    return AddressInUse(
        f"telemetry endpoint {endpoint} is in use: stop the softfinger or other program that holds it, or set "
        f"[telemetry] endpoint to {free}"
    )


class Health:
    """Gathers records and sums up each second of them."""

    def __init__(self) -> None:
        self._rows = np.empty((_HEALTH_ROWS, RECORD_SIZE))
        self._count = 0  # row 0 is the last one of the second before, for the work done between the two
        self._energy_total = 0.0

    def add(self, records: Records, drops: int) -> list[dict[str, Any]]:
        """Take a batch, shape (n, RECORD_SIZE); returns the maps of the seconds that are complete with it."""
        messages: list[dict[str, Any]] = []
        while len(records):
            if self._count == 0:
                self._rows[0] = records[0]
                self._count = 1
                records = records[1:]
                continue
            elapsed = records[:, OFFSET["timestamp"]] - self._rows[0, OFFSET["timestamp"]]
            # A microsecond early: the epoch time of a tick is rounded. A clock set back ends the second too.
            complete = (elapsed >= HEALTH_PERIOD_S - 1e-6) | (elapsed < 0.0)
            room = len(self._rows) - self._count
            ends = int(complete.argmax()) + 1 if complete.any() else len(records)
            taken = min(ends, room)
            self._rows[self._count : self._count + taken] = records[:taken]
            self._count += taken
            if complete[taken - 1] or taken == room:
                messages.append(self._message(drops))
                self._rows[0] = self._rows[self._count - 1]
                self._count = 1
            records = records[taken:]
        return messages

    def _message(self, drops: int) -> dict[str, Any]:
        rows = self._rows[: self._count]
        counted, last = rows[1:], rows[-1]
        elapsed = float(last[OFFSET["timestamp"]] - rows[0, OFFSET["timestamp"]])
        energy = work_of_hand(rows)
        self._energy_total += energy
        modes = np.bincount(counted[:, OFFSET["contact.mode"]].astype(np.int64), minlength=len(MODE_NAMES)).tolist()
        flat = {
            "schema": SCHEMA,
            "timestamp": float(last[OFFSET["timestamp"]]),
            "tick": int(last[_TICK]),
            "rate": len(counted) / elapsed if elapsed > 0.0 else 0.0,
            "missed": int(last[OFFSET["servo.missed"]]),
            "drops": int(drops),
            "guarded": int(np.count_nonzero(counted[:, OFFSET["servo.guard"]])),
            "energy": energy,
            "energy_total": self._energy_total,
            "passivity.owed": max(0.0, -float(counted[:, OFFSET["passivity.energy"]].min(initial=0.0))),
            "passivity.damped": int(np.count_nonzero(counted[:, OFFSET["passivity.damping"]])),
        }
        for name in ("late", "exec"):
            values = counted[:, OFFSET[f"servo.{name}"]]
            quantiles = np.percentile(values, list(_QUANTILES.values())).tolist()
            flat |= {f"{name}.{key}": value for key, value in zip(_QUANTILES, quantiles, strict=True)}
        flat |= {f"modes.{name}": count for name, count in zip(MODE_NAMES, modes, strict=True)}
        return nest(flat)


def work_of_hand(records: Records) -> float:
    """Work (J) the hand did against the commanded wrench over consecutive records, shape (n, RECORD_SIZE).

    Each wrench acts until the next tick, so it multiplies the motion that follows it. Negative means
    that the rendering moved the hand. Records that are not finite count nothing.
    """
    force = records[:-1, OFFSET["force"] : OFFSET["force"] + 3]
    torque = records[:-1, OFFSET["torque"] : OFFSET["torque"] + 3]
    position = records[:, OFFSET["probe.position"] : OFFSET["probe.position"] + 3]
    quaternion = records[:, OFFSET["probe.orientation"] : OFFSET["probe.orientation"] + 4]
    turn = _rotation_between(quaternion[:-1], quaternion[1:])
    work = -(force * np.diff(position, axis=0)).sum(axis=1) - (torque * turn).sum(axis=1)
    return float(work[np.isfinite(work)].sum())


def _rotation_between(before: Records, after: Records) -> Records:
    """Rotation vectors (n, 3), in world, rad, of the shorter turn from quaternions `before` to `after`, (n, 4)."""
    w0, v0 = before[:, :1], before[:, 1:]
    w1, v1 = after[:, :1], after[:, 1:]
    real = w1 * w0 + (v1 * v0).sum(axis=1, keepdims=True)
    vector = w0 * v1 - w1 * v0 - np.cross(v1, v0)  # vector part of after * conjugate(before)
    vector = np.where(real < 0.0, -vector, vector)
    sine = np.linalg.norm(vector, axis=1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, np.abs(real))
    per_sine: Records = np.divide(angle, sine, out=np.full_like(sine, 2.0), where=sine > 0.0)
    return per_sine * vector
