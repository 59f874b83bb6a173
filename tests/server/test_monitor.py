"""`monitor` and `record --poses` against a real publisher: in a terminal, through pipes, with losses, without data."""

import itertools
import json
import logging
import re
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from helpers.called import read_stdout
from helpers.daemons import make_daemon
from helpers.programs import Program, run_program
from helpers.telemetry_records import join, put, synthetic
from helpers.terminal import on_terminal
from helpers.waits import repeated
from rich.console import Console

from softfinger.config.errors import ConfigError, RecordingError
from softfinger.drivers.poses import load_poses
from softfinger.drivers.replay.device import Options, Replay
from softfinger.proxy.record import AT, CAUSE_NAMES
from softfinger.server import cli
from softfinger.server.verbs import monitor
from softfinger.server.verbs.record import RecordingStats, record
from softfinger.server.wire.client import NoTelemetry, subscribe
from softfinger.server.wire.protocol import CONTACT, EVENT, HEALTH, ProtocolError
from softfinger.server.wire.publisher import Publisher

pytestmark = pytest.mark.real_time


@pytest.fixture
def endpoint():
    """Publish sliding at 1 kHz: 20 ticks every 20 ms, each batch with a slip event."""
    firsts = itertools.count(0, 20)
    values = {
        "contact.mode": 2, "contact.object": 3, "contact.normal_force": 1.25, "contact.tangential_force": 0.625,
        "contact.penetration": 0.0015, "contact.spin": np.pi / 4, "force": [0.5, -0.25, 1.25],
        "torque": [0.0, 0.0, 0.002], "servo.late": 12e-6, "servo.exec": 1e-6, "servo.missed": 7,
    }  # fmt: skip

    def publish():
        if not publisher.figures.subscribers:  # health is sent after a second of ticks, and events after it
            return
        first = next(firsts)
        records = synthetic(20, first_tick=first, start_s=time.time() - first / 1000.0)
        for name, value in values.items():
            put(records, name, value)
        put(records[:1], "contact.cause", CAUSE_NAMES.index("drag"))
        publisher.publish(records, drops=4)

    with Publisher("tcp://127.0.0.1:*") as publisher, repeated(publish):
        yield publisher.endpoint


def make_command(*arguments):
    return [sys.executable, "-W", "error", "-m", "softfinger.server.cli", "monitor", *arguments]


def test_once_writes_one_line_with_everything(endpoint):
    output = read_stdout("monitor", "--endpoint", endpoint, "--once")
    assert output.count("\n") == 1 and "\x1b" not in output
    for part in (
        "sliding object 3", "normal 1.250 N tangential 0.625 N", "depth 1.500 mm", "late p99 12.0 us",
        "exec p99 1.0 us", "missed 7 drops 4", "lost 0", "contact slip",
    ):  # fmt: skip
        assert part in output
    assert json.loads(read_stdout("monitor", "--endpoint", endpoint, "--json", "--once"))["mode"] == "sliding"


def test_json_writes_one_object_a_second(endpoint):
    result = run_program(make_command("--endpoint", endpoint, "--json", "--duration", "2.5"), check=True)
    first, *_, last = [json.loads(line) for line in result.stdout.splitlines()]
    assert (last["mode"], last["endpoint"], last["lost"]) == ("sliding", endpoint, 0)
    assert last["contact"]["force"] == [0.5, -0.25, 1.25] and last["contact"]["contact"]["mode"] == 2
    assert last["health"]["missed"] == 7 and last["events"][-1]["name"] == "slip"
    assert first["contact"]["tick"] < last["contact"]["tick"]


def test_not_a_number_becomes_null():
    records = synthetic(1)
    put(records, "force", [np.nan, 0.0, np.inf])
    with Publisher("tcp://127.0.0.1:*") as publisher, repeated(lambda: publisher.publish(records)):
        output = read_stdout("monitor", "--endpoint", publisher.endpoint, "--json", "--once")
    assert json.loads(output)["contact"]["force"] == [None, 0.0, None]


def test_a_closed_pipe_ends_the_monitor(endpoint):
    with Program(
        make_command("--endpoint", endpoint), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert "sliding" in process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == "" and process.wait(30) == 0


def test_a_stopped_stream_is_reported():
    pipe = subprocess.PIPE
    with (
        Publisher("tcp://127.0.0.1:*") as publisher,
        Program(
            make_command("--endpoint", publisher.endpoint, "--timeout", "30"), stdout=pipe, stderr=pipe, text=True
        ) as process,
    ):
        with repeated(lambda: publisher.publish(synthetic(1, first_tick=41))):
            first = process.stdout.readline()
        assert "no data" not in first
        while "no data" not in (line := process.stdout.readline()):
            assert "tick 41 free object -1" in line
        assert re.search(r"no data for [1-9]\.\d s; tick 41 free", line)
        process.send_signal(signal.SIGINT)
        assert process.stderr.read() == "" and process.wait(30) == 0


def test_terminal_shows_the_dashboard(endpoint):
    with on_terminal(make_command("--endpoint", endpoint, "--duration", "2.6"), 40, 100) as (process, pieces):
        written = "".join(pieces)
        assert process.wait(30) == 0, written
    assert re.search(r"\x1b\[1;31msliding", written)
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written)
    screen = plain[plain.rindex("softfinger  tcp") :]
    for words in (
        r"mode +sliding", r"object +number 3 of the scene", r"normal +█{32} +1\.250 N",
        r"tangential +█{16}·{16} +0\.625 N", r"force +0\.500 +-0\.250 +1\.250  N",
        r"torque +0\.000 +0\.000 +2\.000  N mm", r"penetration +1\.500  mm", r"spin +45\.00  deg",
        r"late +p50 +12\.00 +p99 +12\.00 +max +12\.00  us", r"exec +p50 +1\.00 +p99 +1\.00 +max +1\.00  us",
        r"missed 7 +drops 4", r"lost here +0", r"contact slip cause=drag from=1 to=2",
    ):  # fmt: skip
        assert re.search(words, screen), f"{words}\n{screen}"
    assert "\x1b[1A" in written
    assert all(len(line) <= 100 for line in screen.splitlines())


def test_escape_sequences_are_shown_as_text():
    board = monitor.Dashboard("tcp://[::1]:5555")
    sample = monitor.Sample("event", {"schema": 1, "timestamp": 0.0, "tick": 1, "kind": "\x1b[2J", "name": "x"})
    board.update(sample)
    assert "\x1b" not in monitor.format_line(board) and r"\x1b[2J" in monitor.format_line(board)


def make_board(*records, preparing=""):
    with (
        Publisher("tcp://127.0.0.1:*") as publisher,
        subscribe(publisher.endpoint, (CONTACT, EVENT, HEALTH)) as samples,
    ):
        while samples.receive(0.02) is None:  # a subscription takes effect after a delay
            publisher.event("test", "joined")
        publisher.set_preparing(preparing)
        for some in records:
            publisher.publish(some)
        publisher.event("test", "end")
        board = monitor.Dashboard("tcp://127.0.0.1:5555")
        for sample in samples:
            if sample.topic == EVENT and sample["name"] == "end":
                break
            board.update(sample)
    return board


def render_text(board, width=80, height=24):
    console = Console(width=width, height=height, force_terminal=True, color_system=None, legacy_windows=False)
    with console.capture() as capture:
        console.print(monitor.render(board, width, height))
    return capture.get().splitlines()


def make_press(count=1500):
    records = synthetic(count)
    put(records, "contact.mode", 2)
    put(records, "contact.object", 0)
    put(records, "contact.normal_force", 1.25)
    put(records, "contact.tangential_force", 0.5)
    put(records, "force", [0.5, -1e-9, -1.46e-31])
    for tick in range(0, count, 100):
        put(records[tick : tick + 1], "contact.cause", CAUSE_NAMES.index("drag"))
    return records


@pytest.mark.parametrize(("width", "height"), [(80, 24), (80, 40), (120, 30), (200, 60)])
def test_the_dashboard_fits_the_terminal(width, height):
    lines = render_text(make_board(make_press()), width, height)
    text = "\n".join(lines)
    assert len(lines) < height and all(len(line) <= width for line in lines)
    assert "e-31" not in text and "-0.000" not in text and "…" not in text
    events = " ".join(text[text.index("events") :].replace("│", " ").split())
    slip = r"1400 contact slip cause=drag from=1 to=2 object=0 force=\[0\.5, -?\S+, 0\] .* point=\[.*\]"
    assert re.search(slip, events)
    assert "number 0 of the scene" in text


def test_preparations_of_the_daemon_are_shown():
    board = make_board(make_press(), preparing="compiling kernel 12")
    assert any("preparing" in line and "compiling kernel 12" in line for line in render_text(board))
    assert "preparing: compiling kernel 12;" in monitor.format_line(board)


def test_bars_are_empty_after_the_server_stopped(monkeypatch):
    monkeypatch.setattr(monitor, "time", SimpleNamespace(**vars(time) | {"monotonic": lambda: 0.0}))
    board = make_board(make_press())
    assert any("█" in line for line in render_text(board))
    stopped = {"schema": 1, "timestamp": 0.0, "tick": 1500, "kind": "lifecycle", "name": "stopped", "ticks": 1500}
    board.update(monitor.Sample("event", stopped))
    lines = render_text(board)
    assert "the server has stopped" in lines[0] and not any("█" in line for line in lines)
    assert "the server has stopped;" in monitor.format_line(board)
    board.update(board.contact)
    assert any("█" in line for line in render_text(board))
    board._arrived_s -= 2.0
    lines = render_text(board)
    assert "no data for 2.0 s" in lines[0] and not any("█" in line for line in lines)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("rate_hz", [1000.0, 700.0])
def test_a_recording_of_a_replay_is_that_replay(rate_hz: float, tmp_path: Path) -> None:
    file, changes = tmp_path / "again.csv", {"servo.rate_hz": rate_hz, "device.recording": "tap", "device.loop": False}

    def take(endpoint: str) -> RecordingStats:
        with subscribe(endpoint, ("contact", "event")) as wire:
            return record(wire, {"": file}, timeout_s=60.0)[""]

    with make_daemon(changes=changes) as daemon, ThreadPoolExecutor() as pool:
        stats = pool.submit(take, daemon.publisher.endpoint)
        daemon.start()
        daemon.wait(60.0)
        daemon.close()
        totals, played = stats.result(30.0), daemon.devices[0].samples
    assert (totals.end_reason, totals.lost) == ("the server stopped", 0)
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
    np.testing.assert_allclose(poses.t, poses.position[:, 0], rtol=0, atol=1e-15)  # both rounded to milliseconds


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
    assert (totals.poses, totals.unusable) == (99, 1) and "1 skipped" in str(totals)
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
