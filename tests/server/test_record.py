"""`record --poses`: poses written from telemetry equal the poses that `replay` plays."""

from __future__ import annotations

import itertools
import logging
import re
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.daemons import make_daemon
from helpers.telemetry_records import join, put, synthetic
from helpers.waits import repeated

from softfinger.config.errors import ConfigError, RecordingError
from softfinger.drivers.poses import load_poses
from softfinger.drivers.replay.device import Options, Replay
from softfinger.proxy.record import AT
from softfinger.server import cli
from softfinger.server.app import Daemon
from softfinger.server.verbs.record import RecordingStats, record
from softfinger.server.wire.client import NoTelemetry, subscribe
from softfinger.server.wire.protocol import ProtocolError
from softfinger.server.wire.publisher import Publisher

pytestmark = pytest.mark.real_time


RATE_HZ = 1000.0


def record_run(daemon: Daemon, path: Path) -> RecordingStats:
    stats: list[RecordingStats] = []

    def take() -> None:
        with subscribe(daemon.publisher.endpoint, ("contact", "event")) as wire:
            stats.append(record(wire, {"": path}, timeout_s=60.0)[""])

    thread = threading.Thread(target=take)
    thread.start()
    daemon.start()
    daemon.wait(60.0)
    daemon.close()
    thread.join(30.0)
    return stats[0]


def record_replay(path: Path, rate_hz: float = RATE_HZ) -> tuple[RecordingStats, np.ndarray]:
    changes = {"servo.rate_hz": rate_hz, "device.recording": "tap", "device.loop": False}
    with make_daemon(changes=changes) as daemon:
        return record_run(daemon, path), daemon.devices[0].samples


@pytest.mark.sampled(1)
@pytest.mark.parametrize("rate_hz", [1000.0, 700.0])
def test_a_recording_of_a_replay_is_that_replay(rate_hz: float, tmp_path: Path) -> None:
    file = tmp_path / "again.csv"
    totals, played = record_replay(file, rate_hz)
    assert totals.end_reason == "the server stopped"
    assert totals.lost == 0
    assert totals.poses > len(played) - 500, "the recorder was too late for most of it"
    samples = Replay(Options(recording=str(file), loop=False), rate_hz).samples
    assert len(samples) == totals.poses
    # after the end of the recording its last sample is read again
    expected = played[np.minimum(np.arange(totals.first_tick, totals.last_tick + 1), len(played) - 1)]
    assert samples.tobytes() == expected.tobytes()


def record_rows(tmp_path: Path, records: np.ndarray, every: int = 1, **options: Any) -> tuple[RecordingStats, Path]:
    file = tmp_path / "poses.csv"
    with (
        Publisher("tcp://127.0.0.1:*", every=every) as publisher,
        subscribe(publisher.endpoint, ("contact", "event")) as wire,
    ):
        join(publisher, wire._socket)
        publisher.publish(records)
        publisher.event("lifecycle", "stopped")
        return record(wire, {"": file}, **options)[""], file


def make_moving(count: int) -> np.ndarray:
    records = synthetic(count)
    put(records, "dt", 0.001)
    put(records, "probe.orientation", (1.0, 0.0, 0.0, 0.0))
    records[:, AT.probe_position] = np.arange(count) * 1e-3
    return records


def test_gaps_are_reported_and_keep_their_time(tmp_path: Path) -> None:
    totals, file = record_rows(tmp_path, np.delete(make_moving(400), [50, 51, 52, 300], axis=0))
    assert (totals.poses, totals.lost, totals.gap_count, totals.worst) == (396, 4, 2, (49, 3))
    assert "4 ticks in 2 gaps did not arrive, the longest 3 after tick 49" in totals.gaps()
    poses = load_poses(file)
    np.testing.assert_allclose(poses.t, poses.position[:, 0], rtol=0, atol=1e-15)  # both in whole milliseconds


def test_ticks_that_took_longer_take_longer(tmp_path: Path) -> None:
    records = make_moving(250)
    put(records[100:101], "dt", 0.003)
    put(records[0:1], "dt", 0.002)  # late when the recording starts: not the period
    _, file = record_rows(tmp_path, records)
    t = load_poses(file).t
    steps = np.diff(t)
    assert steps[99] == pytest.approx(0.003, abs=1e-12)  # rounding of differences of times below 1 s
    np.testing.assert_allclose(np.delete(steps, 99), 0.001, atol=1e-12)


def test_one_tick_in_five_is_no_gap(tmp_path: Path) -> None:
    totals, file = record_rows(tmp_path, make_moving(501), every=5)
    assert (totals.poses, totals.lost, totals.every) == (101, 0, 5)
    np.testing.assert_allclose(load_poses(file).t, np.arange(101) * 0.005, atol=1e-12)


def test_a_server_that_restarts_ends_the_recording(tmp_path: Path) -> None:
    """Decreasing tick numbers belong to another run, so the file ends before them."""
    totals, file = record_rows(tmp_path, np.vstack([make_moving(100), make_moving(50)]))
    assert totals.end_reason == "the server started again"
    assert len(load_poses(file).t) == 100


def test_an_invalid_pose_is_skipped(tmp_path: Path) -> None:
    records = make_moving(100)
    put(records[30:31], "probe.position", np.nan)
    totals, file = record_rows(tmp_path, records)
    assert (totals.poses, totals.unusable) == (99, 1)
    assert "1 skipped" in str(totals)
    assert len(load_poses(file).t) == 99


def test_bad_files_and_a_missing_server_raise_errors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match=r"poses\.txt: the name of a recording must end in \.csv or \.mcap"):
        record_by_cli(tmp_path / "poses.txt")
    with pytest.raises(RecordingError, match=r"no/poses\.csv: cannot be written: No such file"):
        record_by_cli(tmp_path / "no" / "poses.csv")
    with subscribe("tcp://127.0.0.1:9") as wire, pytest.raises(NoTelemetry, match="softfinger run"):
        record(wire, {"": tmp_path / "poses.csv"}, timeout_s=0.2)
    assert not (tmp_path / "poses.csv").exists(), "no empty file is left behind"


def record_by_cli(path: Path) -> None:
    with Publisher("tcp://127.0.0.1:*") as publisher, subscribe(publisher.endpoint, ("contact", "event")) as wire:
        join(publisher, wire._socket)
        publisher.publish(make_moving(10))
        record(wire, {"": path})


def test_the_verb_reports_ticks_time_and_losses(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    file, records = tmp_path / "poses.csv", make_moving(20_000)
    firsts = itertools.count(0, 100)
    with (
        Publisher("tcp://127.0.0.1:*") as publisher,
        repeated(lambda: publisher.publish(records[(first := next(firsts)) : first + 100]), 0.01),
        caplog.at_level(logging.INFO),
    ):
        words = ["record", "--poses", str(file), "--endpoint", publisher.endpoint, "--duration", "0.5"]
        assert cli.main(words) == 0
    assert re.search(r"500 poses of ticks \d+ to \d+", caplog.text)
    assert "no tick lost; 0.5 s are over" in caplog.text
    assert len(load_poses(file).t) == 500


@pytest.mark.sampled(2)
@pytest.mark.parametrize("dt", [0.0, -0.001, 1e300, np.inf, np.nan])
def test_a_stream_without_a_period_is_refused(dt: float, tmp_path: Path) -> None:
    records = synthetic(300)
    put(records, "dt", dt)
    with pytest.raises(ProtocolError, match=r"tick \d+ has dt = "):
        record_rows(tmp_path, records)
