"""Device at the Inverse Service: filters set when opened, and zero force on every shutdown path.

A shutdown sends a zero, waits for its answer, then closes the connection.
"""

from __future__ import annotations

import os
import time
from typing import Any, Final

from softfinger.config.errors import DeviceLost, DeviceTimeout
from softfinger.drivers.base import make_info
from softfinger.drivers.block import Block, BlockDevice
from softfinger.drivers.closeable import undo_on_error
from softfinger.drivers.haply import connection as service
from softfinger.drivers.haply import exchange
from softfinger.drivers.haply.exchange import AT
from softfinger.drivers.haply.exchange_thread import ExchangeThread
from softfinger.drivers.haply.options import Options, rows
from softfinger.drivers.system.discovery import SystemDevice

__all__ = ["HaplyDevice", "Options", "identify", "open_device", "rows"]

STOP_WAIT_S: Final = 1.0
"""Maximum wait of a stop for the service's answer to a zero."""
POLL_S: Final = 2e-4


class HaplyDevice(BlockDevice):
    """Open device, owner of `connection`."""

    _functions = exchange.read, exchange.write

    def __init__(self, options: Options, connection: service.Connection) -> None:
        self._options = options
        self._block = Block(AT)
        times = exchange.ServiceTimes(options.quiet_s, options.timeout_s, options.stale_s)
        exchange.init_exchange(self._block, options.mounting, options.force_max_n, times)
        grip = "" if connection.grip is None else f" with {connection.grip}"
        self.info = make_info(options, f"haply {connection.device}{grip}", 3 if connection.grip is None else 6)
        self._thread = ExchangeThread(connection, self._block)
        with undo_on_error(self.close):
            self._thread.start()

    def arm(self) -> None:
        """Wait for a current state, and allow forces, unless the device was stopped."""
        word = self._block.word
        before, until = int(word[AT.states]), time.monotonic() + self._options.timeout_s
        while word[AT.states] == before and not word[AT.stopped]:
            if word[AT.failed] < 0:
                raise DeviceLost(f"{self.info.name}: {self.reason()}")
            if time.monotonic() > until:
                raise DeviceTimeout(f"{self.info.name}: the Inverse Service no longer sends states: restart it")
            time.sleep(POLL_S)
        word[AT.dropped_reported] = word[AT.dropped]
        word[AT.armed] = 1

    def thread_ids(self) -> list[int]:
        return [thread for thread in [self._thread.native_id] if thread is not None]

    def stop(self) -> None:
        word = self._block.word
        word[AT.stopped] = 1  # first, because a concurrent `arm` may set `armed` again
        word[AT.armed] = 0  # from now on the thread sends only zeros
        if word[AT.wake] < 0:
            return
        # If a zero of an earlier stop is unanswered, this call waits for the same one.
        if word[AT.stops_answered] == word[AT.stops_requested]:
            word[AT.stops_requested] += 1
            os.eventfd_write(int(word[AT.wake]), 1)
        until = time.monotonic() + (0.0 if self._zero_failure else STOP_WAIT_S)
        while (
            self._thread.is_running and word[AT.stops_answered] < word[AT.stops_requested] and time.monotonic() < until
        ):
            time.sleep(POLL_S)
        self._report_zero_failure(self._explain_unconfirmed(), "zero force is not confirmed")

    def close(self) -> None:
        self.stop()
        self._thread.close()
        wake = int(self._block.word[AT.wake])
        self._block.word[AT.wake] = -1
        if wake >= 0:
            os.close(wake)

    def reason(self) -> str:
        return self._thread.failure

    def warning(self) -> str:
        return self._thread.warning

    def is_settled(self) -> bool:
        """Return True if the service has answered the message with the latest wrench, or cannot any more."""
        word = self._block.word
        return bool(word[AT.answered] >= word[AT.written]) or not self._thread.is_running

    def _explain_unconfirmed(self) -> str:
        """Return why a stop's zero is unconfirmed; empty if its answer or the end of the connection confirms it."""
        if self._block.word[AT.stops_answered] == self._block.word[AT.stops_requested] or self._thread.ended_by_service:
            return ""
        if self._thread.is_running:
            return f"the Inverse Service has not answered it for {STOP_WAIT_S:g} s"
        return f"the Inverse Service has not read it ({self._thread.failure})"


def open_device(options: Options, rate_hz: float) -> HaplyDevice:
    """Open the device that a rig describes, at any rate; raises DeviceError or a subclass if it cannot be used."""
    return HaplyDevice(options, service.open_connection(options))


def identify(_: SystemDevice, options: Options) -> dict[str, Any]:
    """Return the service's description of itself and its devices; sends nothing to a device."""
    return service.identify(options.port, options.version)
