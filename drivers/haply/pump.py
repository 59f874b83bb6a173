"""The thread that speaks to the service: a message with the newest wrench, then the state that answers it.

The service says one state for each message, so a message goes out when the servo has written and the last one is
answered, and every `KEEP_S` where nobody writes. A zero after a force waits for no answer. The thread itself puts zero
in the place of a wrench that is older than `stale`, and of every one while the device is not armed, whatever the servo
does. It never blocks: a service that floods, hangs or closes ends it, and `read` says so.
"""

from __future__ import annotations

import logging
import os
import select
import threading
import time
from collections import deque
from contextlib import suppress
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
"""From one message to the next where nothing new is to be said, so that poses keep coming."""
UNASKED_MAX: Final = 100
"""States more than messages, after which this is no Inverse Service."""
CLOSE_WAIT_S: Final = 1.0
_ZERO: Final = (0.0, 0.0, 0.0)


class Asked(NamedTuple):
    """A message that waits for its state: the number of its wrench, and how many stops had been asked for."""

    number: int
    stops: int


class Pump:
    """The thread and what it keeps. The link of `found` is the pump's from now on; `block` is laid out by AT."""

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
        self.failure = ""
        """What ended the thread before it was closed; empty while nothing did."""
        self.warning = ""
        """What is not as it should be, by the newest state."""
        read(self._wrenches, -1, self._copy)  # compiled now, and not in the thread
        self._publish(found.seen)
        self._thread = threading.Thread(target=self._run, name="haply exchange", daemon=True)

    def start(self) -> None:
        turns.shorten()
        self._thread.start()

    @property
    def running(self) -> bool:
        return self._thread.is_alive()

    def close(self) -> None:
        """End the thread and the connection. Any number of times."""
        self._ending.set()
        if self._thread.ident is None:
            self._found.link.close()
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
        except Exception as error:  # a defect here must not leave a loop that waits
            log.exception("the exchange with the Inverse Service failed")
            self._fail(PROTOCOL, repr(error))
        finally:
            self._leave()
            turns.restore()

    def _leave(self) -> None:
        """A last zero, whatever has ended the exchange, and the connection's end."""
        with suppress(Exception):  # it may be closed, or take nothing
            self._found.link.send(command(self._found.device, self._found.key, _ZERO))
        self._found.link.close()

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
        force, now, stops = self._force(), time.monotonic_ns(), int(self._word[AT.stops])
        if stops > self._stops or (self._loaded and force == _ZERO):
            due = True
        else:
            number = int(self._newest[NUMBER])
            due = not self._asked and (number != self._number or now - self._sent_at >= KEEP_S * 1e9)
        if not due:
            return
        self._number, self._stops, self._sent_at = int(self._newest[NUMBER]), stops, now
        self._asked.append(Asked(self._number, stops))
        self._found.link.send(command(self._found.device, self._found.key, force))
        self._word[AT.messages] += 1
        self._loaded = force != _ZERO

    def _force(self) -> Vec3:
        """The newest force, or zero where none may go out."""
        sequence = read(self._wrenches, self._sequence, self._copy)
        if sequence != self._sequence:
            self._sequence = sequence
            self._newest[:] = self._copy
        x, y, z, at = self._newest[: WRITTEN + 1].tolist()
        force = (x, y, z)
        if force != _ZERO and (not self._word[AT.armed] or time.monotonic_ns() - at > self._word[AT.stale]):
            if self._loaded:
                self._word[AT.dropped] += 1
            return _ZERO
        return force

    def _take(self, message: bytes) -> None:
        found = self._found
        self._publish(read_state(message, found.device, found.grip))
        if not self._asked:
            self._word[AT.unasked] += 1
            if self._word[AT.unasked] > UNASKED_MAX:
                raise Malformed(f"the service has said {UNASKED_MAX} states that nobody asked for")
            return
        asked = self._asked.popleft()
        self._word[AT.answered], self._word[AT.stopped] = asked.number, asked.stops

    def _publish(self, seen: Seen) -> None:
        self._pose[:] = (*seen.position, *seen.orientation, seen.buttons, time.monotonic_ns())
        publish(self._poses, self._pose)
        self.warning = seen.warning
        self._word[AT.states] += 1


def _counters(block: Block, at: int) -> Any:
    return block.word[at : at + COUNTERS]
