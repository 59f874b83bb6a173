"""Supervisor: commands zero force if ticks stop unexpectedly. Runs above the servo's priority."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

from softfinger.config.errors import HapticError, SafetyStop
from softfinger.server.loop import fault_detection, shutdown
from softfinger.server.loop.servo_thread import ServoThread
from softfinger.server.services.base import Worker


class Supervisor(Worker):
    """Service that monitors a servo from its start to its last tick."""

    def __init__(self, servo: ServoThread, fail: Callable[[HapticError], None], event: Callable[..., Any]) -> None:
        super().__init__("supervisor")
        self._servo, self._fail, self._event = servo, fail, event

    def work(self) -> None:
        watchdog = fault_detection.Watchdog()
        # An armed servo is monitored up to its last tick; one that was never armed may never have been started.
        while self._servo.is_ticking and (self._servo.is_armed or not self.closing.is_set()):
            time.sleep(fault_detection.STALL_POLL_S)
            ticks = self._servo.ticks
            has_force = any(device.info.has_persistent_force for device in self._servo.devices)
            polls = fault_detection.STALL_POLLS if has_force else fault_detection.STALL_POLLS_WITHOUT_HAND
            idle_s = watchdog.measure_stall_s(ticks, self._servo.is_armed, polls)
            if idle_s and self._servo.is_ticking:
                self._stop_stalled(idle_s, ticks)
                return

    def handle_failure(self, error: Exception) -> None:
        """End the run: an unmonitored servo may stall with a force."""
        self._fail(SafetyStop(f"the supervisor failed: {error}; a stall of the servo would not be detected"))

    def _stop_stalled(self, idle_s: float, ticks: int) -> None:
        stalled = SafetyStop(
            f"no tick for {idle_s:.2f} s after tick {ticks}: zero force was commanded; "
            "the exchange with a device does not return, or the machine gives the servo thread no time"
        )
        shutdown.run_all_steps(
            lambda: self._fail(stalled),  # first: it takes no time, unlike stopping a device
            lambda: shutdown.stop_all(self._servo.devices),
            lambda: self._event("fault", "stalled", message=str(stalled)),
            first=stalled,
        )
