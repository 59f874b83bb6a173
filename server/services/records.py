"""Distribution of records from the relay to their consumers in Python: one thread passes each batch to every sink.

Telemetry is the first of them; it also publishes start and end of the run.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import HapticError, SafetyStop
from softfinger.drivers.base import join_names
from softfinger.server.loop import shutdown
from softfinger.server.loop.servo_thread import ServoThread
from softfinger.server.services.base import Worker
from softfinger.server.wire.native.relay import Tap
from softfinger.server.wire.publisher import Publisher

log: Final = logging.getLogger(__name__)

BATCH: Final = 256


class Sink(NamedTuple):
    """Consumer of records.

    name   name in logs and events
    take   is called with batches (n, fingers x RECORD_SIZE), a row per tick, in order, and with the number of ticks
           lost so far; the next batch overwrites the array, so it must copy what it needs, and it must not wait
    vital  returns the error that ends the run if `take` raises; None: the sink is removed, with an event, and the run
           continues
    """

    name: str
    take: Callable[[NDArray[np.float64], int], None]
    vital: Callable[[Exception], HapticError] | None = None


class RecordService(Worker):
    """Service that reads the relay's tap, from the servo's start to the last record after its end.

    sinks  consumers, in the order of their calls; a sink that failed is not called again

    It also releases the servo, which must outlive its reader.
    """

    def __init__(
        self,
        servo: ServoThread,
        tap: Tap,
        sinks: list[Sink],
        fail: Callable[[HapticError], None],
        event: Callable[..., Any],
    ) -> None:
        super().__init__("records")
        self._servo, self._tap, self._sinks, self._fail, self._event = servo, tap, list(sinks), fail, event
        self._abandoned = False

    def work(self) -> None:
        try:
            batch = np.empty((BATCH, self._servo.width))
            running = True
            while running:
                self._tap.wait()
                # read before the tap is emptied, so that records from before the end are passed on
                running = not (self._tap.ended or self._abandoned)
                while (count := self._tap.take(batch)) > 0:
                    self._distribute(batch[:count], self._servo.records.drops + self._tap.lost)
            if self._tap.failed:
                raise RuntimeError("the thread that forwards ticks has ended")
        finally:
            self._tap.close()

    def _distribute(self, records: NDArray[np.float64], drops: int) -> None:
        for sink in list(self._sinks):
            try:
                sink.take(records, drops)
            except Exception as error:
                self._sinks.remove(sink)
                if sink.vital is not None:
                    log.exception("%s failed; stopping", sink.name)
                    self._fail(sink.vital(error))
                else:
                    log.exception("%s failed; continuing without it", sink.name)
                    self._event("fault", "sink", sink=sink.name, message=str(error))

    def handle_failure(self, error: Exception) -> None:
        """End the run: without records, rendering cannot be monitored."""
        self._fail(SafetyStop(f"ticks cannot be received: {error}; they would not be published"))

    def stop(self) -> None:
        # A servo that was never started, or that hangs, produces no last record.
        shutdown.complete_all_steps(
            *([self._abandon] if self._servo.is_running else []),
            super().stop,
            self._release,
            *([self._tap.close] if self._thread.ident is None else []),
        )

    def _abandon(self) -> None:
        self._abandoned = True
        self._tap.wake()

    def _release(self) -> None:
        if not self._servo.is_running and not self._thread.is_alive():  # a reader that did not end in time still reads
            self._servo.close()


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
        self._publisher.event("lifecycle", "started", device=join_names(self._servo.devices))
        self._announced = True

    def stop(self) -> None:
        shutdown.complete_all_steps(self._publish_stopped, self._publisher.close)

    def _publish_stopped(self) -> None:
        if self._announced:
            self._publisher.event("lifecycle", "stopped", ticks=self._servo.ticks)
