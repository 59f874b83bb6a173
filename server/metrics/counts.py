"""Metrics for Prometheus: sums and histograms, computed by numpy over batches of records.

Names follow Prometheus' conventions: base units, `_total` for counters. docs/operate/metrics.md lists them.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator, Sequence
from importlib.metadata import version
from typing import Any, Final

import numpy as np
from prometheus_client.core import (
    CounterMetricFamily,
    GaugeMetricFamily,
    HistogramMetricFamily,
    InfoMetricFamily,
    Metric,
)
from prometheus_client.registry import Collector

from softfinger.config.arrays import Array
from softfinger.drivers.base import HELD, WITHHELD
from softfinger.proxy.record import AT, MODE_NAMES, RECORD_SIZE
from softfinger.server.loop.guard import GUARD_NAMES
from softfinger.server.recording.recorder import RecorderState
from softfinger.server.socket_process.channel_messages import Figures
from softfinger.server.states import DaemonState

ROWS: Final = 1024
"""Ticks per computation: a batch of one tick takes as long as one of this size."""

LATENESS_S: Final = [float(f"{step}e{power}") for power in (-6, -5, -4, -3) for step in (1, 2, 5)]
FORCE_N: Final = [0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0, 20.0, 40.0]
"""Upper bounds of the buckets; the last bucket is unbounded."""

STATUSES: Final = {1: "repeated_or_limited", WITHHELD: "withheld", HELD: "held"}
"""Labels of device statuses other than success."""

_COLUMNS: Final = [
    AT.servo_late,
    AT.servo_exec,
    AT.dt,
    AT.contact_mode,
    AT.servo_guard,
    AT.servo_device,
    *range(AT.force, AT.force + 3),
]


class Histogram:
    """Counts of values per bucket, and their sum."""

    def __init__(self, bounds: Sequence[float]) -> None:
        self._bounds = np.asarray(bounds)
        self._counts = np.zeros(len(bounds) + 1, np.int64)
        self._sum = 0.0

    def add(self, values: Array) -> None:
        """Count values (n,); a value equal to a bound counts below it, as in Prometheus."""
        self._counts += np.bincount(np.searchsorted(self._bounds, values), minlength=len(self._counts))
        self._sum += float(values.sum())

    def write_to(self, family: HistogramMetricFamily, labels: Sequence[str] = ()) -> None:
        """Add the cumulative counts and the sum to a metric family."""
        bounds = [*(f"{bound:g}" for bound in self._bounds), "+Inf"]
        counts = np.cumsum(self._counts).tolist()
        family.add_metric(
            labels, [(bound, float(count)) for bound, count in zip(bounds, counts, strict=True)], self._sum
        )


class FingerCounts:
    """Sums of one finger."""

    def __init__(self) -> None:
        self.force = Histogram(FORCE_N)
        self.modes_s = np.zeros(len(MODE_NAMES))
        self.guard_ticks = np.zeros(len(GUARD_NAMES), np.int64)
        self.statuses = np.zeros(max(STATUSES) + 1, np.int64)

    def add(self, rows: Array) -> None:
        """Count rows (n, columns)."""
        _, _, dt, mode, guard, status = rows[:, :6].T
        self.force.add(np.linalg.norm(rows[:, 6:], axis=1))
        self.modes_s += np.bincount(mode.astype(np.int64), weights=dt, minlength=len(MODE_NAMES))
        bits = guard.astype(np.int64)[:, None] >> np.arange(len(GUARD_NAMES)) & 1
        self.guard_ticks += bits.sum(axis=0)
        self.statuses += np.bincount(status.astype(np.int64), minlength=len(self.statuses))[: len(self.statuses)]


class MetricsCollector(Collector):
    """Collector that receives records and returns the metrics on a scrape; thread-safe.

    Parameters
    ----------
    fingers
        Names of several fingers; one empty name for a single finger.
    wire
        Returns the figures of the publisher, and the number of restarts of its processes.
    written
        Returns the counts of the recordings.
    state
        Returns the state of the daemon.
    """

    def __init__(
        self,
        fingers: Sequence[str],
        wire: Callable[[], tuple[Figures, int]],
        written: Callable[[], RecorderState],
        state: Callable[[], DaemonState],
    ) -> None:
        self._names, self._wire, self._written, self._state = tuple(fingers), wire, written, state
        self._lock = threading.Lock()
        self._rows = np.empty((ROWS, len(self._names), len(_COLUMNS)))
        self._pending_rows = self._ticks = self._missed = self._drops = 0
        self._late, self._exec = Histogram(LATENESS_S), Histogram(LATENESS_S)
        self._fingers = [FingerCounts() for _ in self._names]

    def add_records(self, records: Array, drops: int) -> None:
        """Receive a batch (n, fingers x RECORD_SIZE), and the number of ticks lost by the ring buffer so far."""
        with self._lock:
            self._drops, self._missed = drops, int(records[-1, AT.servo_missed])
            self._ticks += len(records)
            remaining = records.reshape(len(records), -1, RECORD_SIZE)
            while len(remaining):
                free = ROWS - self._pending_rows
                part, remaining = remaining[:free], remaining[free:]
                self._rows[self._pending_rows : self._pending_rows + len(part)] = part[:, :, _COLUMNS]
                self._pending_rows += len(part)
                if self._pending_rows == ROWS:
                    self._count()

    def _count(self) -> None:
        rows = self._rows[: self._pending_rows]
        self._late.add(rows[:, 0, 0])
        self._exec.add(rows[:, 0, 1])
        for index, finger in enumerate(self._fingers):
            finger.add(rows[:, index])
        self._pending_rows = 0

    def collect(self) -> Iterator[Metric]:
        with self._lock:
            self._count()
            metrics = [*self._iter_servo_metrics(), *self._iter_finger_metrics()]
        figures, restarts = self._wire()
        yield from metrics
        yield GaugeMetricFamily("softfinger_subscribers", "Connections with a subscription", figures.subscribers)
        yield from _iter_counters(
            ("messages_lost", "Messages lost because subscribers were too slow", figures.lost),
            ("connections_refused", "Connections refused or closed because of their messages", figures.refused),
            ("publisher_restarts", "Restarts of the processes of telemetry and commands", restarts),
        )
        yield from _iter_recording_metrics(self._written())
        state, now = GaugeMetricFamily("softfinger_state", "1 for the daemon's state", labels=["state"]), self._state()
        for daemon_state in DaemonState:
            state.add_metric([daemon_state.value], float(daemon_state is now))
        yield state
        yield InfoMetricFamily("softfinger_build", "What runs", {"version": version("softfinger")})

    def _iter_servo_metrics(self) -> Iterator[Metric]:
        yield from _iter_counters(
            ("ticks", "Ticks of the servo", self._ticks),
            ("deadlines_missed", "Deadlines of the servo that passed without a tick", self._missed),
            ("records_dropped", "Ticks lost because the daemon was too slow", self._drops),
        )
        for name, text, histogram in (
            ("softfinger_lateness_seconds", "Wake-up of the servo after its deadline", self._late),
            ("softfinger_execution_seconds", "Time from the servo's wake-up until the device was written", self._exec),
        ):
            family = HistogramMetricFamily(name, text)
            histogram.write_to(family)
            yield family

    def _iter_finger_metrics(self) -> Iterator[Metric]:
        force = HistogramMetricFamily("softfinger_force_newtons", "Force on the hand", labels=["finger"])
        modes = CounterMetricFamily("softfinger_mode_seconds", "Time in a contact mode", labels=["finger", "mode"])
        guard = CounterMetricFamily("softfinger_guarded_ticks", "Ticks the guard changed", labels=["finger", "cause"])
        errors = CounterMetricFamily(
            "softfinger_device_errors", "Ticks in which a device did not execute a request", labels=["finger", "status"]
        )
        for name, finger in zip(self._names, self._fingers, strict=True):
            finger.force.write_to(force, [name])
            _label(modes, name, zip(MODE_NAMES, finger.modes_s.tolist(), strict=True))
            _label(guard, name, zip(GUARD_NAMES, finger.guard_ticks.tolist(), strict=True))
            _label(errors, name, ((text, int(finger.statuses[status])) for status, text in STATUSES.items()))
        yield from (force, modes, guard, errors)


def _iter_recording_metrics(totals: RecorderState) -> Iterator[Metric]:
    slow = "not recorded because the disk was too slow"
    yield from _iter_counters(
        ("recorded_ticks", "Ticks in recordings, of the first finger", totals.ticks),
        ("recorded_bytes", "Bytes of recordings", totals.bytes),
        ("unrecorded_ticks", f"Ticks of any finger that were {slow}", totals.dropped),
        ("unrecorded_events", f"Events that were {slow}", totals.events_dropped),
    )
    yield GaugeMetricFamily(
        "softfinger_recording_worst_write_seconds", "Longest duration of a write to the disk", totals.worst_write_s
    )


def _iter_counters(*rows: tuple[str, str, float]) -> Iterator[Metric]:
    for name, text, value in rows:
        yield CounterMetricFamily(f"softfinger_{name}", text, value)


def _label(family: CounterMetricFamily, finger: str, values: Any) -> None:
    for label, value in values:
        family.add_metric([finger, label], value)
