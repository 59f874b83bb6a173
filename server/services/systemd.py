"""Notifications to systemd: READY at the first tick, WATCHDOG while ticks continue, and STOPPING.

For a process started with `Type=notify`, systemd sets NOTIFY_SOCKET to a datagram socket, and WATCHDOG_USEC to the
longest interval between signs of life. The sign of life is a tick of the servo, not of this thread, so it ends when the
ticks end.
"""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Mapping
from typing import Final

from softfinger.server.loop.servo_thread import ServoThread
from softfinger.server.services.base import Worker

log: Final = logging.getLogger(__name__)

POLL_S: Final = 0.05
"""Interval of the check for ticks, and so the largest delay of READY."""

SEND_S: Final = 0.1
"""Time for which a message waits: a service manager that hangs must not delay the end of the daemon."""


class ServiceNotifier(Worker):
    """Service that notifies systemd of a servo; start it before the servo and stop it after the servo.

    environment  with NOTIFY_SOCKET, and WATCHDOG_USEC and WATCHDOG_PID if there is a watchdog
    """

    def __init__(self, servo: ServoThread, environment: Mapping[str, str]) -> None:
        super().__init__("notify")
        self._servo = servo
        name = environment["NOTIFY_SOCKET"]
        self._address = f"\0{name[1:]}" if name.startswith("@") else name  # @: an abstract name
        self._period_s = min(_read_watchdog_s(environment) / 4.0, 1.0)

    def work(self) -> None:
        ready, reported_ticks, next_report_s = False, 0, 0.0
        while not self.closing.wait(min(POLL_S, self._period_s)):
            ticks, now = self._servo.ticks, time.monotonic()
            if ticks == reported_ticks or now < next_report_s:
                continue
            state = ["WATCHDOG=1", f"STATUS={ticks} ticks, {self._servo.missed} missed"]
            ready = self._send(*state, *([] if ready else ["READY=1"])) or ready
            reported_ticks, next_report_s = ticks, now + self._period_s

    def stop(self) -> None:
        super().stop()
        self._send("STOPPING=1", "STATUS=stopping", "WATCHDOG_USEC=0")  # TimeoutStopSec limits closing

    def handle_failure(self, error: Exception) -> None:
        """Do nothing: without a sign of life, systemd ends the daemon."""

    def _send(self, *state: str) -> bool:
        """Send a message; return False if a service manager that hangs, has exited or restarts does not accept it."""
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as to:
            to.settimeout(SEND_S)
            try:
                to.sendto("\n".join(state).encode(), self._address)
            except OSError as error:
                log.debug("systemd was not notified of %s: %s", state, error)
                return False
        return True


def _read_watchdog_s(environment: Mapping[str, str]) -> float:
    """Return the time after which systemd considers a silent daemon dead, s; infinite without a watchdog."""
    if environment.get("WATCHDOG_PID", str(os.getpid())) != str(os.getpid()):
        return float("inf")
    try:
        watchdog_us = int(environment["WATCHDOG_USEC"])
    except (KeyError, ValueError):
        return float("inf")
    return watchdog_us / 1e6 if watchdog_us > 0 else float("inf")  # as sd_watchdog_enabled(3) interprets it
