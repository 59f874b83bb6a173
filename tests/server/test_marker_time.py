"""Time of a marker: the same tick and time for subscribers, recordings and Lab Streaming Layer, on the ticks' clock."""

import json
import os
import signal
import subprocess
import sys
from itertools import accumulate, chain, repeat
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
from helpers.processes import COMMAND
from helpers.waits import WAIT_S, until

from softfinger.config.load import load_rig, load_scene
from softfinger.proxy.record import AT, FIELDS, list_columns
from softfinger.server.app import Daemon
from softfinger.server.gateway import lsl
from softfinger.server.loop import servo_thread
from softfinger.server.recording.results import read_results
from softfinger.server.recording.run import Run, load_run
from softfinger.server.remote import Client
from softfinger.server.wire.protocol import EVENT

pytestmark = pytest.mark.real_time

MARKS = 20
APART_S = 10.0
"""Offset between the daemon's epoch and the machine's clock, as if the clock had been set."""
DIGIT_S = 1e-6
"""A time since the epoch in a double has a resolution of 0.24 us; two differences and a sum round four times."""
LSL_S = 1e-3
"""Documented accuracy. LSL's clock and CLOCK_MONOTONIC differ only by the time between two calls."""
INLETS = """
import json, sys, time
import pylsl
def inlet(name):
    (found,) = pylsl.resolve_byprop("source_id", f"{name} {sys.argv[1]}", timeout=60.0)
    opened = pylsl.StreamInlet(found, max_buflen=60)
    opened.open_stream(60.0)
    return opened
ticks, markers = inlet("softfinger"), inlet("softfinger-events")
stream = ticks.info(60.0)
rate, channel, names, units = stream.nominal_srate(), stream.desc().child("channels").child("channel"), [], []
while not channel.empty():
    names.append(channel.child_value("label"))
    units.append(channel.child_value("unit"))
    channel = channel.next_sibling()
print("ready", flush=True)
seen, told, last, rows = {}, [], None, {}
while last not in seen:  # the streams are separate connections: a marker may arrive before its tick
    samples, stamps = ticks.pull_chunk(0.05)
    seen |= {int(sample[1]): stamp for sample, stamp in zip(samples, stamps)}
    rows |= {int(sample[1]): sample for sample in samples}
    samples, stamps = markers.pull_chunk(0.0)
    told += [(json.loads(sample[0]), stamp) for sample, stamp in zip(samples, stamps)]
    last = next((event["tick"] for event, _ in told if event.get("label") == "the last"), None)
pairs = [(time.monotonic(), pylsl.local_clock(), time.monotonic()) for _ in range(10)]
before, clock, after = min(pairs, key=lambda pair: pair[2] - pair[0])
found = {"ticks": list(seen.items()), "markers": told, "offset": clock - (before + after) / 2}
print(json.dumps(found | {"rate": rate, "names": names, "units": units, "values": rows[last]}))
"""


class MarkedRun(NamedTuple):
    published: list[dict[str, Any]]
    run: Run
    epoch_s: float
    lsl: dict[str, Any] | None
    records: np.ndarray


def start_inlets(stack: Any, folder: Path, endpoint: str) -> tuple[Any, Any] | None:
    try:
        import pylsl  # noqa: F401
    except (ImportError, RuntimeError):
        return None
    settings = folder / "lsl.cfg"
    settings.write_text("[multicast]\nResolveScope = machine\n")
    env = os.environ | {"LSLAPICFG": str(settings)}
    forward = [*COMMAND, "-q", "forward", "--lsl", "--from", endpoint]
    sending = subprocess.Popen(forward, env=env, stdout=subprocess.DEVNULL)
    stack.append(sending)
    inlets = subprocess.Popen([sys.executable, "-c", INLETS, endpoint], env=env, stdout=subprocess.PIPE, text=True)
    stack.append(inlets)
    assert inlets.stdout is not None and inlets.stdout.readline() == "ready\n"
    return sending, inlets


@pytest.fixture(scope="module")
def marked_run(tmp_path_factory: pytest.TempPathFactory) -> MarkedRun:
    folder = tmp_path_factory.mktemp("marks")
    ends = {"telemetry.endpoint": f"ipc://{folder}/t", "commands.endpoint": f"ipc://{folder}/c"}
    rig = load_rig("simulated-hand", ends | {"servo.realtime": "off", "recording.directory": str(folder)})
    started: list[subprocess.Popen[str]] = []
    with pytest.MonkeyPatch.context() as patch:
        real = servo_thread._read_epoch_offset_ns()
        patch.setattr(servo_thread, "_read_epoch_offset_ns", lambda: real + int(APART_S * 1e9))
        with Daemon(rig, load_scene("paper-plane")) as daemon, Client(*ends.values(), timeout_s=WAIT_S) as client:
            daemon.start()
            try:
                streams = start_inlets(started, folder, ends["telemetry.endpoint"])
                client.record_start("run.mcap")
                events = client.subscribe((EVENT,), timeout_s=WAIT_S)
                published: list[dict[str, Any]] = []
                while not published:  # a subscription takes effect after a delay
                    client.mark("first")
                    published += [] if (sample := events.receive(0.1)) is None else [sample.data]
                for number in range(MARKS):
                    client.mark(f"mark {number}", {"number": number})
                client.mark("the last")
                while published[-1].get("label") != "the last":
                    published.append(next(events).data)
                until(lambda: client.get_state().sequence >= published[-1]["tick"] + 10)  # ticks after the last mark
                client.record_stop()
                lsl_data = None if streams is None else json.loads(streams[1].communicate(timeout=WAIT_S)[0])
            finally:
                for process in started:
                    process.send_signal(signal.SIGINT)
                    process.communicate(timeout=WAIT_S)
            epoch_s = daemon.servo.epoch_s
    run = load_run(folder / "run.mcap", ("timestamp",))
    return MarkedRun(published, run, epoch_s, lsl_data, read_results(folder / "run.mcap"))


def select_marks(events: list[dict[str, Any]]) -> list[dict[str, Any]]:
    return [event for event in events if event["kind"] == "mark" and event["label"].startswith("mark ")]


def test_a_marker_is_between_its_tick_and_the_next(marked_run: MarkedRun) -> None:
    ticks, times = marked_run.run.first["tick"], marked_run.run.first["timestamp"]
    assert len(select_marks(marked_run.published)) == MARKS
    for event in select_marks(marked_run.published):
        at = int(np.searchsorted(ticks, event["tick"]))
        assert ticks[at] == event["tick"]
        after = times[at + 2]  # this tick starts after the end of the next one
        assert times[at] <= event["timestamp"] <= after


def test_recording_and_subscribers_have_equal_markers(marked_run: MarkedRun) -> None:
    recorded = select_marks(marked_run.run.events)
    assert [(e["label"], e["tick"], e["timestamp"]) for e in recorded] == [
        (e["label"], e["tick"], e["timestamp"]) for e in select_marks(marked_run.published)
    ]


def test_lsl_has_the_time_of_the_tick(marked_run: MarkedRun) -> None:
    if marked_run.lsl is None:
        pytest.skip("pylsl is not installed: pip install 'softfinger[lsl]'")
    stamps = dict(marked_run.lsl["ticks"])
    times = dict(zip(marked_run.run.first["tick"].tolist(), marked_run.run.first["timestamp"].tolist(), strict=True))
    markers = [pair for pair in marked_run.lsl["markers"] if pair[0].get("label", "").startswith("mark ")]
    assert len(markers) == MARKS
    for event, stamp in markers:
        published = next(mark for mark in select_marks(marked_run.published) if mark["label"] == event["label"])
        assert event["tick"] == published["tick"] and event["data"] == published["data"]
        distance = stamp - stamps[event["tick"]]
        assert distance == pytest.approx(published["timestamp"] - times[event["tick"]], abs=DIGIT_S)
        assert stamp - marked_run.lsl["offset"] == pytest.approx(published["timestamp"] - marked_run.epoch_s, abs=LSL_S)


def test_lsl_has_every_number_of_a_tick(marked_run: MarkedRun) -> None:
    if marked_run.lsl is None:
        pytest.skip("pylsl is not installed: pip install 'softfinger[lsl]'")
    assert marked_run.lsl["names"] == list_columns() and marked_run.lsl["rate"] == 0.0  # irregular
    assert marked_run.lsl["units"] == [field.unit for field in FIELDS for _ in range(field.size)]
    values = marked_run.lsl["values"]
    (row,) = marked_run.records[marked_run.records[:, AT.tick] == values[AT.tick]]
    assert values == row.tolist()


def test_a_pause_between_two_clocks_does_not_shift_the_stamps(monkeypatch: pytest.MonkeyPatch) -> None:
    steps = chain([0.0, 0.02, 0.0, 0.02], repeat(1e-6))
    read = accumulate(steps).__next__
    fake = SimpleNamespace(local_clock=read, StreamOutlet=lambda _: None, StreamInfo=lambda *_: None, IRREGULAR_RATE=0)
    monkeypatch.setitem(sys.modules, "pylsl", fake)
    monkeypatch.setattr(lsl, "time", SimpleNamespace(monotonic=read, time=read))
    outlets = lsl.Outlets("a daemon")
    assert outlets._lsl_s == pytest.approx(0.0, abs=LSL_S)
    assert outlets._to_local_s == pytest.approx(0.0, abs=LSL_S)
