"""Metrics: counts against direct sums, names by Prometheus' rules, and a dashboard that matches the endpoint."""

from __future__ import annotations

import json
import re
import socket
import time
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from helpers.pages import running
from helpers.telemetry_records import put, synthetic
from prometheus_client.parser import text_string_to_metric_families

from softfinger.config.errors import AddressInUse
from softfinger.proxy.record import AT, MODE_NAMES
from softfinger.server.app import Daemon
from softfinger.server.loop.guard import GUARD_NAMES
from softfinger.server.metrics.counts import (
    FORCE_N,
    LATENESS_S,
    ROWS,
    STATUSES,
    MetricsCollector,
)
from softfinger.server.metrics.service import make_dashboard
from softfinger.server.recording.recorder import RecorderState
from softfinger.server.recording.summary import summarize
from softfinger.server.socket_process.setup import Figures
from softfinger.server.states import DaemonState

pytestmark = pytest.mark.real_time

NOTHING = RecorderState()
UNITS = ("seconds", "newtons", "info", "total")
COUNTED = re.compile(r"softfinger_[a-z_]+")


def index_samples(families) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in families
        for sample in family.samples
    }


@pytest.mark.parametrize("batch", [1, 300, 5000])
def test_figures_equal_those_computed_from_records(batch: int) -> None:
    count, random = 2 * ROWS + 77, np.random.default_rng(5)
    fingers = [synthetic(count, seed=seed) for seed in (1, 2)]
    for rows in fingers:
        put(rows, "contact.mode", random.integers(0, 3, count))
        put(rows, "servo.guard", random.integers(0, 1 << len(GUARD_NAMES), count))
        put(rows, "servo.device", random.choice([0, *STATUSES], count))
        put(rows, "dt", 0.125)
    late = random.exponential(1e-4, count)
    put(fingers[0], "servo.late", late)
    put(fingers[0], "servo.missed", np.arange(count))
    counts = MetricsCollector(
        ["thumb", "index"],
        lambda: (Figures(3, 4, 5), 6),
        lambda: RecorderState(6, 8, 7, "", True, 9, 0.25),
        lambda: DaemonState.ARMED,
    )
    together = np.concatenate(fingers, axis=1)
    for start in range(0, count, batch):
        counts.add_records(together[start : start + batch], 9)
    stats = index_samples(counts.collect())
    assert stats["softfinger_ticks_total", ()] == count
    assert stats["softfinger_deadlines_missed_total", ()] == count - 1
    assert stats["softfinger_records_dropped_total", ()] == 9
    assert [stats[f"softfinger_{name}", ()] for name in
            ("subscribers", "messages_lost_total", "connections_refused_total")] == [3, 4, 5]  # fmt: skip
    assert [stats[f"softfinger_{name}", ()] for name in (
        "recorded_ticks_total", "recorded_bytes_total", "unrecorded_ticks_total", "unrecorded_events_total",
        "recording_worst_write_seconds",
    )] == [6, 7, 8, 9, 0.25]  # fmt: skip
    for end in LATENESS_S:
        assert stats["softfinger_lateness_seconds_bucket", (("le", f"{end:g}"),)] == np.count_nonzero(late <= end)
    for name, rows in zip(("thumb", "index"), fingers, strict=True):
        label, norm = ("finger", name), np.linalg.norm(rows[:, AT.force : AT.force + 3], axis=1)
        for end in FORCE_N:
            key = (label, ("le", f"{end:g}"))
            assert stats["softfinger_force_newtons_bucket", key] == np.count_nonzero(norm <= end)
        for number, mode in enumerate(MODE_NAMES):
            spent = 0.125 * np.count_nonzero(rows[:, AT.contact_mode] == number)
            assert stats["softfinger_mode_seconds_total", (label, ("mode", mode))] == spent
        for bit, cause in enumerate(GUARD_NAMES):
            ticks = np.count_nonzero(rows[:, AT.servo_guard].astype(int) >> bit & 1)
            assert stats["softfinger_guarded_ticks_total", (("cause", cause), label)] == ticks
        for status, text in STATUSES.items():
            ticks = np.count_nonzero(rows[:, AT.servo_device] == status)
            assert stats["softfinger_device_errors_total", (label, ("status", text))] == ticks


def scrape(daemon: Daemon) -> dict:
    with urllib.request.urlopen(f"{daemon.metrics_endpoint}/metrics", timeout=60.0) as answer:
        return index_samples(text_string_to_metric_families(answer.read().decode()))


@pytest.fixture
def daemon() -> Iterator[Daemon]:
    with running("replay", "paper-plane", metrics__endpoint="127.0.0.1:0") as daemon:
        yield daemon


def test_a_running_daemon_is_scraped(daemon: Daemon) -> None:
    host, port = daemon.metrics_endpoint.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port))):
        until, stats = time.monotonic() + 60.0, scrape(daemon)
        first = stats["softfinger_ticks_total", ()]
        while scrape(daemon)["softfinger_ticks_total", ()] <= first:
            assert time.monotonic() < until
    stats = scrape(daemon)
    assert stats["softfinger_execution_seconds_count", ()] == stats["softfinger_ticks_total", ()]
    modes = sum(value for (name, _), value in stats.items() if name == "softfinger_mode_seconds_total")
    # Ticks of a recording are a period each; rounding of sums of thousands.
    assert modes == pytest.approx(1e-3 * stats["softfinger_ticks_total", ()], rel=1e-9)
    with (
        pytest.raises(AddressInUse, match=r"\[metrics\] endpoint"),
        running("replay", "paper-plane", metrics__endpoint=f"{host}:{port}"),
    ):
        pass


def test_recordings_add_up(tmp_path: Path) -> None:
    ends = {"metrics__endpoint": "127.0.0.1:0", "recording__directory": str(tmp_path)}
    with running("replay", "paper-plane", **ends) as daemon:
        files = [tmp_path / "first.mcap", tmp_path / "second.mcap"]
        for file in files:
            before = scrape(daemon)["softfinger_recorded_ticks_total", ()]
            daemon.recordings.begin(file.name, "paper-plane")
            until = time.monotonic() + 60.0
            while scrape(daemon)["softfinger_recorded_ticks_total", ()] <= before:
                assert time.monotonic() < until
            daemon.recordings.end()
        while (written := daemon.recordings.collect_totals()).bytes < sum(file.stat().st_size for file in files):
            assert time.monotonic() < until + 60.0
        stats = scrape(daemon)
    assert stats["softfinger_recorded_bytes_total", ()] == written.bytes == sum(file.stat().st_size for file in files)
    assert stats["softfinger_recorded_ticks_total", ()] == sum(summarize(file)["ticks"] for file in files)
    assert stats["softfinger_unrecorded_ticks_total", ()] == stats["softfinger_unrecorded_events_total", ()] == 0
    assert stats["softfinger_recording_worst_write_seconds", ()] > 0.0


def test_the_dashboard_uses_all_metrics(daemon: Daemon) -> None:
    with urllib.request.urlopen(f"{daemon.metrics_endpoint}/dashboard.json", timeout=60.0) as answer:
        board = json.load(answer)
    assert board == make_dashboard()
    queries = [target["expr"] for panel in board["panels"] for target in panel["targets"]]
    queried = {name for query in queries for name in COUNTED.findall(query)}
    published = {name for name, _ in scrape(daemon)}
    assert queried <= published
    assert {re.sub("_(bucket|sum|count)$", "", name) for name in published} == {
        re.sub("_(bucket|sum|count)$", "", name) for name in queried
    }


def test_names_follow_prometheus_rules_and_are_on_the_page() -> None:
    page = (Path(__file__).parents[2] / "docs" / "operate" / "metrics.md").read_text("utf-8")
    rows = {row[0]: set(re.findall(r"`(\w+)`", row[1])) for row in re.findall(r"^\| `(\w+)` \| (.*?) \|", page, re.M)}
    stats: dict[str, set[str]] = {}
    for family in MetricsCollector([""], lambda: (Figures(), 0), lambda: NOTHING, lambda: DaemonState.READY).collect():
        for sample in family.samples:
            name = re.sub("_(bucket|sum|count)$", "", sample.name)
            assert name.endswith(UNITS) or name in ("softfinger_subscribers", "softfinger_state"), name
            stats.setdefault(name, set()).update(sample.labels.keys() - {"le"})
    assert rows == stats
