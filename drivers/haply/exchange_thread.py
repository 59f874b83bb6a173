"""Thread that exchanges messages with the service: sends the latest wrench, and receives the state that answers it.

The service sends one state per message. So the thread sends a message when the servo has written a wrench and the last
message is answered, and every `MESSAGE_PERIOD_S` without a new wrench: at most one force is in transmission. A zero
after a force does not wait for an answer. The thread sends zero instead of a wrench that is older than `stale`, and
instead of every wrench while the device is disarmed or the service does not read, regardless of the servo. It never
blocks: a service that floods, hangs or closes ends the thread, and `read` returns the status. Its last message is a
zero, before any Close frame.
"""

from __future__ import annotations

import logging
import os
import select
import threading
import time
from collections import deque
from typing import Final

import numpy as np

from softfinger.config.errors import DeviceError, DeviceTimeout
from softfinger.drivers import switch_interval
from softfinger.drivers.base import LOST, PROTOCOL, TIMEOUT
from softfinger.drivers.block import Block
from softfinger.drivers.haply.connection import Connection
from softfinger.drivers.haply.exchange import AT, POSE_SIZE, WRENCH_NUMBER, WRENCH_SIZE, WRITE_TIME
from softfinger.drivers.haply.messages import Malformed, Missing, PoseReading, encode_command, read_state
from softfinger.proxy.kernels.jit.seqlock import publish, read
from softfinger.proxy.kernels.model import Vec3

log: Final = logging.getLogger(__name__)

MESSAGE_PERIOD_S: Final = 0.005
"""Interval of messages without a new wrench, so that poses continue to arrive."""
UNREAD_MAX: Final = 2
"""Maximum number of messages unread by the service; with more, it sends states without reading."""
UNREAD: Final = "the Inverse Service reads no messages, so forces are withheld: restart it"
SURPLUS_MAX: Final = 100
"""Maximum surplus of states over messages; with more, the program at the port is not an Inverse Service."""
CLOSE_WAIT_S: Final = 1.0
_ZERO: Final = (0.0, 0.0, 0.0)


class ExchangeThread:
    """Exchange thread, owner of the link in `connection`; AT lays out `block`."""

    def __init__(self, connection: Connection, block: Block) -> None:
        self._connection, self._word = connection, block.word
        self._poses, self._wrenches = block.slot(AT.pose, POSE_SIZE), block.slot(AT.wrench, WRENCH_SIZE)
        self._pose, self._latest_wrench = np.zeros(POSE_SIZE), np.zeros(WRENCH_SIZE)
        self._copy = np.zeros(WRENCH_SIZE)
        self._sequence = self._stops = 0
        self._sent_at = self._number = 0
        self._has_force = False
        self._pending: deque[tuple[int, int]] = deque()
        """Messages without an answer yet: number of the wrench, and number of stops requested before it."""
        self._is_closing = threading.Event()
        self._warning = ""
        self._message_bytes_max, self._has_unread = 0, False
        self.failure = ""
        """Reason why the thread ended before it was closed; empty if it did not."""
        self.ended_by_service = False
        """True if the service closed the connection, which ends its session and the forces of the session."""
        read(self._wrenches, -1, self._copy)  # compile it before the thread runs
        self._publish(connection.reading)
        self._thread = threading.Thread(target=self._run, name="haply exchange", daemon=True)

    def start(self) -> None:
        """Start the thread; if the system has none left, close the connection and raise RuntimeError."""
        switch_interval.shorten()
        try:
            self._thread.start()
        except BaseException:
            switch_interval.restore()
            self._close_link()
            raise

    @property
    def native_id(self) -> int | None:
        return self._thread.native_id

    @property
    def is_running(self) -> bool:
        return self._thread.is_alive()

    @property
    def warning(self) -> str:
        """Return problems reported by the latest state and the connection; empty without any."""
        return "; ".join(filter(None, (self._warning, UNREAD if self._has_unread else "")))

    def close(self) -> None:
        """End the thread and the connection. May be called repeatedly."""
        self._is_closing.set()
        if self._thread.ident is None:
            self._close_link()
            return
        if self._word[AT.wake] >= 0:
            os.eventfd_write(int(self._word[AT.wake]), 1)
        self._thread.join(CLOSE_WAIT_S)
        if self._thread.is_alive():
            log.error("the thread of the Inverse Service hangs and is abandoned")

    def _run(self) -> None:
        try:
            self._exchange()
        except (Missing, DeviceTimeout, DeviceError) as error:
            self._fail(TIMEOUT if isinstance(error, DeviceTimeout) else LOST, str(error))
        except Malformed as error:
            self._fail(PROTOCOL, str(error))
        except Exception as error:  # after a defect here, the loop must not wait forever
            log.exception("the exchange with the Inverse Service failed")
            self._fail(PROTOCOL, repr(error))
        finally:
            switch_interval.restore()
            self._close_link()

    def _close_link(self) -> None:
        """Send a last zero, after any end of the exchange, and close the connection."""
        with self._connection.lock:
            link, device, key = self._connection.link, self._connection.device, self._connection.key
            self.ended_by_service = link.close(encode_command(device, key, _ZERO))

    def _fail(self, status: int, why: str) -> None:
        self.failure = why
        self._word[AT.failed] = status

    def _exchange(self) -> None:
        link, wake, poll = self._connection.link, int(self._word[AT.wake]), select.poll()
        poll.register(link.fileno(), select.POLLIN)
        poll.register(wake, select.POLLIN)
        while not self._is_closing.is_set():
            self._send_if_due()
            for fd, _ in poll.poll(1e3 * MESSAGE_PERIOD_S):
                if fd == wake:
                    os.eventfd_read(wake)
                    continue
                for message in link.receive():
                    self._process_state(message)

    def _send_if_due(self) -> None:
        link = self._connection.link
        self._has_unread = link.count_unread_bytes() > UNREAD_MAX * self._message_bytes_max
        force, now, stops = self._read_force(), time.monotonic_ns(), int(self._word[AT.stops_requested])
        number = int(self._latest_wrench[WRENCH_NUMBER])
        if stops <= self._stops and not (self._has_force and force == _ZERO):
            is_due = number != self._number or now - self._sent_at >= MESSAGE_PERIOD_S * 1e9
            if self._pending or self._has_unread or not is_due:
                return
        self._number, self._stops, self._sent_at = number, stops, now
        self._pending.append((number, stops))
        message = encode_command(self._connection.device, self._connection.key, force)
        self._message_bytes_max = max(self._message_bytes_max, len(message))
        link.send(message)
        self._has_force = force != _ZERO
        self._word[AT.messages] += 1
        self._word[AT.handled] = number

    def _read_force(self) -> Vec3:
        """Return the latest force, or zero if none may be sent."""
        sequence = read(self._wrenches, self._sequence, self._copy)
        if sequence != self._sequence:
            self._sequence = sequence
            self._latest_wrench[:] = self._copy
        x, y, z, at = self._latest_wrench[: WRITE_TIME + 1].tolist()
        force = (x, y, z)
        is_armed = self._word[AT.armed] and not self._word[AT.stopped]
        is_old = time.monotonic_ns() - at > self._word[AT.stale]
        if force != _ZERO and (not is_armed or is_old or self._has_unread):
            self._latest_wrench[:WRITE_TIME] = 0.0  # permanently: it must not be sent when the service reads again
            self._word[AT.dropped] += 1
            self._word[AT.handled] = int(self._latest_wrench[WRENCH_NUMBER])
            return _ZERO
        return force

    def _process_state(self, message: bytes) -> None:
        connection = self._connection
        self._publish(read_state(message, connection.device, connection.grip))
        if not self._pending:
            self._word[AT.unasked] += 1
            if self._word[AT.unasked] > SURPLUS_MAX:
                raise Malformed(f"the service sent {SURPLUS_MAX} unexpected states")
            return
        self._word[AT.answered], self._word[AT.stops_answered] = self._pending.popleft()

    def _publish(self, reading: PoseReading) -> None:
        self._pose[:] = (*reading.position, *reading.orientation, reading.buttons, time.monotonic_ns())
        publish(self._poses, self._pose)
        self._warning = reading.warning
        self._word[AT.states] += 1
