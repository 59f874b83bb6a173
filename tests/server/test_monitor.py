"""`monitor` against a real publisher: in a terminal, through pipes, and without data."""

import itertools
import json
import re
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from helpers.called import called
from helpers.programs import Program, run_program
from helpers.telemetry_records import put, synthetic
from helpers.terminal import on_terminal
from helpers.waits import repeated
from rich.console import Console

from softfinger.proxy.record import CAUSE_NAMES
from softfinger.server.cli import main
from softfinger.server.verbs import monitor
from softfinger.server.wire.client import subscribe
from softfinger.server.wire.protocol import CONTACT, EVENT, HEALTH
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


def run_piped(*arguments):
    return run_program(make_command(*arguments))


def test_once_writes_one_line_with_everything(endpoint):
    result = called("monitor", "--endpoint", endpoint, "--once")
    assert result.returncode == 0, result.stderr
    assert result.stdout.count("\n") == 1
    for part in (
        "sliding object 3",
        "normal 1.250 N tangential 0.625 N",
        "depth 1.500 mm",
        "late p99 12.0 us",
        "exec p99 1.0 us",
        "missed 7 drops 4",
        "lost 0",
        "contact slip",
    ):
        assert part in result.stdout
    assert "\x1b" not in result.stdout
    result = called("monitor", "--endpoint", endpoint, "--json", "--once")
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["contact"]["contact"]["mode"] == 2


def test_json_writes_one_object_a_second(endpoint):
    result = run_piped("--endpoint", endpoint, "--json", "--duration", "2.5")
    assert result.returncode == 0, result.stderr
    objects = [json.loads(line) for line in result.stdout.splitlines()]
    assert len(objects) >= 2
    last = objects[-1]
    assert last["mode"] == "sliding"
    assert last["endpoint"] == endpoint
    assert last["contact"]["force"] == [0.5, -0.25, 1.25]
    assert last["health"]["missed"] == 7
    assert last["lost"] == 0
    assert last["events"][-1]["name"] == "slip"
    assert objects[0]["contact"]["tick"] < last["contact"]["tick"]


def test_not_a_number_becomes_null():
    records = synthetic(1)
    put(records, "force", [np.nan, 0.0, np.inf])
    with Publisher("tcp://127.0.0.1:*") as publisher, repeated(lambda: publisher.publish(records)):
        result = called("monitor", "--endpoint", publisher.endpoint, "--json", "--once")
    assert json.loads(result.stdout)["contact"]["force"] == [None, 0.0, None]


def test_a_closed_pipe_ends_the_monitor(endpoint):
    with Program(
        make_command("--endpoint", endpoint), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        assert "sliding" in process.stdout.readline()
        process.stdout.close()
        assert process.stderr.read() == ""
        assert process.wait(30) == 0


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
        assert process.stderr.read() == ""
        assert process.wait(30) == 0


def test_terminal_shows_the_dashboard(endpoint):
    with on_terminal(make_command("--endpoint", endpoint, "--duration", "2.6"), 40, 100) as (process, pieces):
        written = "".join(pieces)
        assert process.wait(30) == 0, written
    assert re.search(r"\x1b\[1;31msliding", written)
    plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written)
    screen = plain[plain.rindex("softfinger  tcp") :]
    for words in (
        r"mode +sliding",
        r"object +number 3 of the scene",
        r"normal +█{32} +1\.250 N",
        r"tangential +█{16}·{16} +0\.625 N",
        r"force +0\.500 +-0\.250 +1\.250  N",
        r"torque +0\.000 +0\.000 +2\.000  N mm",
        r"penetration +1\.500  mm",
        r"spin +45\.00  deg",
        r"late +p50 +12\.00 +p99 +12\.00 +max +12\.00  us",
        r"exec +p50 +1\.00 +p99 +1\.00 +max +1\.00  us",
        r"missed 7 +drops 4",
        r"lost here +0",
        r"contact slip cause=drag from=1 to=2",
    ):
        assert re.search(words, screen), f"{words}\n{screen}"
    assert "\x1b[1A" in written
    assert all(len(line) <= 100 for line in screen.splitlines())


def test_escape_sequences_are_shown_as_text():
    board = monitor.Board("tcp://[::1]:5555")
    sample = monitor.Sample("event", {"schema": 1, "timestamp": 0.0, "tick": 1, "kind": "\x1b[2J", "name": "x"})
    board.update(sample)
    assert "\x1b" not in monitor.format_line(board)
    assert r"\x1b[2J" in monitor.format_line(board)


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
        board = monitor.Board("tcp://127.0.0.1:5555")
        while (sample := samples.receive(0.3)) is not None:
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
    assert re.search(
        r"1400 contact slip cause=drag from=1 to=2 object=0 force=\[0\.5, -?\S+, 0\] .* point=\[.*\]", events
    )
    assert "number 0 of the scene" in text


def test_preparations_of_the_daemon_are_shown():
    board = make_board(make_press(), preparing="compiling kernel 12")
    assert any("preparing" in line and "compiling kernel 12" in line for line in render_text(board))
    assert "preparing: compiling kernel 12;" in monitor.format_line(board)


def test_bars_are_empty_after_the_server_stopped():
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


@pytest.mark.parametrize("verb", ["monitor", "record"])
@pytest.mark.parametrize("words", [("--duration", "0"), ("--duration", "nan"), ("--timeout", "-1")])
def test_durations_that_are_not_positive_are_refused(verb, words, capsys):
    with pytest.raises(SystemExit):
        main([verb, *words])
    assert f"argument {words[0]}: {words[1]}: the duration must be above 0 s" in capsys.readouterr().err
