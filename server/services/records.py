"""Records from the relay to whoever takes them in Python: one thread, which hands each batch to every sink."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import HapticError, SafetyStop
from softfinger.server.loop import shutdown
from softfinger.server.loop.servo_thread import Servo
from softfinger.server.services.base import Worker
from softfinger.server.wire.native.relay import Tap

log: Final = logging.getLogger(__name__)

BATCH: Final = 256


class Sink(NamedTuple):
    """Something that takes records.

    name    of it, in logs and events
    take    is given batches (n, fingers x RECORD_SIZE), a row a tick, in order, and how many ticks did not
            get here so far; a batch is
            overwritten by the next, so it copies what it keeps, and waits for nobody
    vital   the error that the run ends with when `take` raises; None: the sink is left out from there on, with an
            event, and the run goes on
    """

    name: str
    take: Callable[[NDArray[np.float64], int], None]
    vital: Callable[[Exception], HapticError] | None = None


class Records(Worker):
    """Reads what the relay hands on, from the servo's start to the last record after its end.

    tap    where it is read
    sinks  in the order in which they are given each batch; a sink that failed gets no more
    fail   ends the run with an error
    event  publishes an event

    It also releases the servo, which must outlive its reader.
    """

    def __init__(
        self,
        servo: Servo,
        tap: Tap,
        sinks: list[Sink],
        fail: Callable[[HapticError], None],
        event: Callable[..., Any],
    ) -> None:
        super().__init__("records")
        self._servo, self._tap, self._sinks, self._fail, self._event = servo, tap, list(sinks), fail, event
        self._given_up = False

    def work(self) -> None:
        try:
            self._read()
        finally:
            self._tap.close()

    def _read(self) -> None:
        batch = np.empty((BATCH, self._servo.width))
        running = True
        while running:
            self._tap.wait()
            # asked before it is emptied: what came before the end is handed on
            running = not (self._tap.ended or self._given_up)
            while (count := self._tap.take(batch)) > 0:
                self._hand_on(batch[:count], self._servo.records.drops + self._tap.lost)
        if self._tap.failed:
            raise RuntimeError("the thread that hands ticks on has ended")

    def _hand_on(self, records: NDArray[np.float64], drops: int) -> None:
        for sink in list(self._sinks):
            try:
                sink.take(records, drops)
            except Exception as error:
                self._sinks.remove(sink)
                self._dropped(sink, error)

    def _dropped(self, sink: Sink, error: Exception) -> None:
        if sink.vital is not None:
            log.exception("%s failed; stopping", sink.name)
            self._fail(sink.vital(error))
            return
        log.exception("%s failed; going on without it", sink.name)
        self._event("fault", "sink", sink=sink.name, message=str(error))

    def failed(self, error: Exception) -> None:
        """No sink's fault: nobody can see what is rendered."""
        self._fail(SafetyStop(f"records cannot be taken: {error}; nobody can see what is rendered"))

    def stop(self) -> None:
        # Of a servo that was never started, or hangs, no last record will come.
        failed = shutdown.every(*([self._give_up] if self._servo.running else []), super().stop, self._release)
        if self._thread.ident is None:
            self._tap.close()
        if failed is not None:
            raise failed

    def _give_up(self) -> None:
        self._given_up = True
        self._tap.wake()

    def _release(self) -> None:
        if not self._servo.running and not self._thread.is_alive():  # a reader that was not waited for still reads
            self._servo.close()
