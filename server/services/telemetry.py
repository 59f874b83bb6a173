"""Telemetry service: publishes start and end of the run, and closes the publisher after the last record."""

from __future__ import annotations

from softfinger.config.errors import SafetyStop
from softfinger.drivers.base import list_names
from softfinger.server.loop import shutdown
from softfinger.server.loop.servo_thread import ServoThread
from softfinger.server.services.records import Sink
from softfinger.server.wire.publisher import Publisher


class TelemetryService:
    """Service of an open publisher; its `sink` is vital, because without it rendering cannot be monitored."""

    def __init__(self, publisher: Publisher, servo: ServoThread) -> None:
        self._publisher, self._servo = publisher, servo
        self._announced = False
        self.sink = Sink(
            "publisher",
            publisher.observe,
            lambda error: SafetyStop(f"telemetry cannot be published: {error}"),
        )

    def start(self) -> None:
        self._publisher.attach(self._servo.records)
        self._publisher.event("lifecycle", "started", device=list_names(self._servo.devices))
        self._announced = True

    def stop(self) -> None:
        shutdown.complete_all_steps(self._publish_stopped, self._publisher.close)

    def _publish_stopped(self) -> None:
        if self._announced:
            self._publisher.event("lifecycle", "stopped", ticks=self._servo.ticks)
