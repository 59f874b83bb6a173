"""What systemd is told of the daemon: READY with the first tick, a sign of life for as long as ticks go on, STOPPING.

Started by systemd with `Type=notify`, a process is given a datagram socket by NOTIFY_SOCKET, and by WATCHDOG_USEC how
long it may say nothing. The sign of life is a tick of the servo, not of this thread: where ticks stop, so does it.
"""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Mapping
from typing import Final

from softfinger.server.loop.servo_thread import Servo
from softfinger.server.services.base import Worker

log: Final = logging.getLogger(__name__)

POLL_S: Final = 0.05
"""How often ticks are looked for: READY comes so much late at the most."""


class Notify(Worker):
    """Tells systemd of a servo, from its first tick to its last zero. To be started before it and stopped behind it.

    environment  with NOTIFY_SOCKET, and WATCHDOG_USEC and WATCHDOG_PID where there is a watchdog
    """

    def __init__(self, servo: Servo, environment: Mapping[str, str]) -> None:
        super().__init__("notify")
        self._servo = servo
        self._address = _address(environment["NOTIFY_SOCKET"])
        self._period_s = min(_watchdog_s(environment) / 4.0, 1.0)

    def work(self) -> None:
        ready, told, due = False, 0, 0.0
        while not self.closing.wait(min(POLL_S, self._period_s)):
            ticks, now = self._servo.ticks, time.monotonic()
            if ticks == told or now < due:
                continue
            state = ["WATCHDOG=1", f"STATUS={ticks} ticks, {self._servo.missed} missed"]
            self._send(*state, *([] if ready else ["READY=1"]))
            ready, told, due = True, ticks, now + self._period_s

    def stop(self) -> None:
        super().stop()
        self._send("STOPPING=1", "STATUS=stopping", "WATCHDOG_USEC=0")  # closing has TimeoutStopSec, and no ticks

    def failed(self, error: Exception) -> None:
        """Nothing: with no sign of life any more, systemd ends the daemon."""

    def _send(self, *state: str) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as to:
            try:
                to.sendto("\n".join(state).encode(), self._address)
            except OSError as error:  # a manager that has gone, or is restarted
                log.debug("systemd was not told %s: %s", state, error)


def _address(name: str) -> str:
    """Of a socket as NOTIFY_SOCKET has it: a path, or behind an `@` an abstract name."""
    return f"\0{name[1:]}" if name.startswith("@") else name


def _watchdog_s(environment: Mapping[str, str]) -> float:
    """Time after which systemd takes a silent daemon for dead, s; endless where it does not watch this process."""
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return float("inf")
    try:
        return int(environment["WATCHDOG_USEC"]) / 1e6
    except (KeyError, ValueError):
        return float("inf")
