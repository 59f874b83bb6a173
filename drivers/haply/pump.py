"""Thread that exchanges messages with the service: sends the latest wrench, and receives the state that answers it.

The service sends one state per message. So the thread sends a message when the servo has written a wrench and the last
message is answered, and every `KEEP_S` without a new wrench: at most one force is in transmission. A zero after a force
does not wait for an answer. The thread sends zero instead of a wrench that is older than `stale`, and instead of every
wrench while the device is disarmed or the service does not read, regardless of the servo. It never blocks: a service
that floods, hangs or closes ends the thread, and `read` returns the status. Its last message is a zero, before any
Close frame.
"""

from __future__ import annotations

import logging
import os
import select
import threading
import time
from collections import deque
from typing import Any, Final, NamedTuple

import numpy as np

from softfinger.config.errors import DeviceError, DeviceTimeout
from softfinger.drivers import turns
from softfinger.drivers.base import LOST, PROTOCOL, TIMEOUT
from softfinger.drivers.block import Block
from softfinger.drivers.haply.exchange import AT, COUNTERS, NUMBER, POSE, WRENCH, WRITTEN
from softfinger.drivers.haply.messages import Malformed, Missing, Seen, command, read_state
from softfinger.drivers.haply.opening import Found
from softfinger.proxy.kernels.jit.seqlock import Slot, publish, read
from softfinger.proxy.kernels.model import Vec3

log: Final = logging.getLogger(__name__)

KEEP_S: Final = 0.005
"""Interval of messages without a new wrench, so that poses continue to arrive."""
UNREAD_MAX: Final = 2
"""Maximum number of messages unread by the service; with more, it sends states without reading."""
UNREAD: Final = "the Inverse Service reads no messages, so forces are withheld: restart it"
UNASKED_MAX: Final = 100
"""Maximum surplus of states over messages; with more, the program at the port is not an Inverse Service."""
CLOSE_WAIT_S: Final = 1.0
_ZERO: Final = (0.0, 0.0, 0.0)


class Asked(NamedTuple):
    """Message without an answer yet: number of its wrench, and number of stops requested before it."""

    number: int
    stops: int


class Pump:
    """Exchange thread, owner of the link in `found`; AT lays out `block`."""

    def __init__(self, found: Found, block: Block) -> None:
        self._found, self._word = found, block.word
        self._poses = Slot(_counters(block, AT.pose_sequence), block.numbers(AT.pose, POSE))
        self._wrenches: Any = Slot(_counters(block, AT.wrench_sequence), block.numbers(AT.wrench, WRENCH))
        self._pose, self._newest = np.zeros(POSE), np.zeros(WRENCH)
        self._copy = np.zeros(WRENCH)
        self._sequence = self._stops = 0
        self._sent_at = self._number = 0
        self._loaded = False
        self._asked: deque[Asked] = deque()
        self._ending = threading.Event()
        self._warning = ""
        self._size, self._unread = 0, False
        self.failure = ""
        """Reason why the thread ended before it was closed; empty if it did not."""
        self.ended_by_service = False
        """True if the service closed the connection, which ends its session and the forces of the session."""
        read(self._wrenches, -1, self._copy)  # compile it before the thread runs
        self._publish(found.seen)
        self._thread = threading.Thread(target=self._run, name="haply exchange", daemon=True)

    def start(self) -> None:
        turns.shorten()
        self._thread.start()

    @property
    def running(self) -> bool:
        return self._thread.is_alive()

    @property
    def warning(self) -> str:
        """Return problems reported by the latest state and the connection; empty without any."""
        return "; ".join(filter(None, (self._warning, UNREAD if self._unread else "")))

    def close(self) -> None:
        """End the thread and the connection. May be called repeatedly."""
        self._ending.set()
        if self._thread.ident is None:
            self._leave()
            return
        if self._word[AT.wake] >= 0:
            os.eventfd_write(int(self._word[AT.wake]), 1)
        self._thread.join(CLOSE_WAIT_S)
        if self._thread.is_alive():
            log.error("the thread that speaks to the Inverse Service hangs; it is left behind")

    def _run(self) -> None:
        try:
            self._serve()
        except (Missing, DeviceTimeout, DeviceError) as error:
            self._fail(TIMEOUT if isinstance(error, DeviceTimeout) else LOST, str(error))
        except Malformed as error:
            self._fail(PROTOCOL, str(error))
        except Exception as error:  # after a defect here, the loop must not wait forever
            log.exception("the exchange with the Inverse Service failed")
            self._fail(PROTOCOL, repr(error))
        finally:
            turns.restore()
            self._leave()

    def _leave(self) -> None:
        """Send a last zero, after any end of the exchange, and close the connection."""
        with self._found.lock:
            link, device, key = self._found.link, self._found.device, self._found.key
            self.ended_by_service = link.close(command(device, key, _ZERO))

    def _fail(self, status: int, why: str) -> None:
        self.failure = why
        self._word[AT.failed] = status

    def _serve(self) -> None:
        link, wake, poll = self._found.link, int(self._word[AT.wake]), select.poll()
        poll.register(link.fileno(), select.POLLIN)
        poll.register(wake, select.POLLIN)
        while not self._ending.is_set():
            self._send_if_due()
            for fd, _ in poll.poll(1e3 * KEEP_S):
                if fd == wake:
                    os.eventfd_read(wake)
                    continue
                for message in link.receive():
                    self._take(message)

    def _send_if_due(self) -> None:
        link = self._found.link
        self._unread = link.queued() > UNREAD_MAX * self._size
        force, now, stops = self._force(), time.monotonic_ns(), int(self._word[AT.stops])
        number = int(self._newest[NUMBER])
        if stops <= self._stops and not (self._loaded and force == _ZERO):
            new = number != self._number or now - self._sent_at >= KEEP_S * 1e9
            if self._asked or self._unread or not new:
                return
        self._number, self._stops, self._sent_at = number, stops, now
        self._asked.append(Asked(number, stops))
        message = command(self._found.device, self._found.key, force)
        self._size = max(self._size, len(message))
        link.send(message)
        self._loaded = force != _ZERO
        self._word[AT.messages] += 1
        self._word[AT.taken] = number

    def _force(self) -> Vec3:
        """Return the latest force, or zero if none may be sent."""
        sequence = read(self._wrenches, self._sequence, self._copy)
        if sequence != self._sequence:
            self._sequence = sequence
            self._newest[:] = self._copy
        x, y, z, at = self._newest[: WRITTEN + 1].tolist()
        force = (x, y, z)
        old = not self._word[AT.armed] or time.monotonic_ns() - at > self._word[AT.stale]
        if force != _ZERO and (old or self._unread):
            self._newest[:WRITTEN] = 0.0  # permanently: it must not be sent when the service reads again
            self._word[AT.dropped] += 1
            self._word[AT.taken] = int(self._newest[NUMBER])
            return _ZERO
        return force

    def _take(self, message: bytes) -> None:
        found = self._found
        self._publish(read_state(message, found.device, found.grip))
        if not self._asked:
            self._word[AT.unasked] += 1
            if self._word[AT.unasked] > UNASKED_MAX:
                raise Malformed(f"the service sent {UNASKED_MAX} states that nobody asked for")
            return
        asked = self._asked.popleft()
        self._word[AT.answered], self._word[AT.stopped] = asked.number, asked.stops

    def _publish(self, seen: Seen) -> None:
        self._pose[:] = (*seen.position, *seen.orientation, seen.buttons, time.monotonic_ns())
        publish(self._poses, self._pose)
        self._warning = seen.warning
        self._word[AT.states] += 1


def _counters(block: Block, at: int) -> Any:
    return block.word[at : at + COUNTERS]
