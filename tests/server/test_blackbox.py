"""Black box: its contents, its size limits, and the file named in the event of a fault."""

import logging
import os
import signal
import time
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.daemons import make_daemon
from helpers.waits import eventually
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from softfinger.config.errors import ConfigError, DeviceLost
from softfinger.config.load import build
from softfinger.config.schema import Faults
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.recording import blackbox
from softfinger.server.recording.blackbox import BYTES_MAX, FILES_MAX, HISTORY_S, BlackBox, list_files, prepare_folder
from softfinger.server.recording.reader import Event, TickBlock, read_contents
from softfinger.server.wire.client import subscribe

WAIT_S = 60.0


def records(first: int, count: int) -> np.ndarray:
    rows = np.zeros((count, RECORD_SIZE))
    rows[:, AT.tick] = np.arange(first, first + count)
    rows[:, AT.timestamp] = time.time()
    return rows


def read_ticks(path: Path) -> list[int]:
    parts = [part.records() for part in read_contents(path) if isinstance(part, TickBlock)]
    return [int(tick) for part in parts for tick in part[:, AT.tick]]


@pytest.mark.plain
@pytest.mark.parametrize("batches", [(5,), (250, 250), (999, 999, 7), (2500,), (1000,), (1,) * 30])
def test_the_last_ticks_are_written_in_order(batches: tuple[int, ...], tmp_path: Path) -> None:
    box, first = BlackBox([""], [], 100.0), 0
    for count in batches:
        box.take(records(first, count))
        first += count
    box.write(tmp_path / "box.mcap", {})
    assert read_ticks(tmp_path / "box.mcap") == list(range(max(0, first - round(100.0 * HISTORY_S)), first))


@pytest.mark.plain
def test_old_events_take_no_memory() -> None:
    box, old = BlackBox([""], [], 100.0), time.time() - HISTORY_S - 60.0
    tracemalloc.start()
    try:
        for number in range(1000):
            box.event({"timestamp": old, "kind": "mark", "name": f"{number:010000d}"})
        allocated, _ = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert allocated < 10 * 10_000  # bytes of ten names; a thousand would need a hundred times as much


@pytest.mark.plain
def test_old_events_and_log_lines_are_not_written(tmp_path: Path) -> None:
    box, now = BlackBox([""], [], 100.0), time.time()
    box.take(records(0, 3))
    for age in (HISTORY_S + 5.0, 1.0):
        about = {"schema": 1, "timestamp": now - age, "tick": 1, "kind": "fault", "name": f"{age:g} s ago"}
        box.event(about | {"message": "x"})
        record = logging.LogRecord("softfinger.test", logging.ERROR, "file", 1, f"{age:g} s ago", None, None)
        record.created = now - age
        box.log.handle(record)
    box.write(tmp_path / "box.mcap", {"scene_name": "s"})
    with (tmp_path / "box.mcap").open("rb") as file:
        decoded = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages()
        messages = [(channel.topic, message) for _, channel, _, message in decoded]
    assert [message.name for topic, message in messages if topic == "event"] == ["1 s ago"]
    ((level, name, text),) = [(m.level, m.name, m.message) for topic, m in messages if topic == "log"]
    assert (level, name, text) == (4, "softfinger.test", "1 s ago")  # 4: ERROR in Foxglove's schema


@pytest.mark.plain
def test_a_failed_write_leaves_no_file(tmp_path: Path) -> None:
    box = BlackBox([""], [], 100.0)
    with pytest.raises(FileNotFoundError):
        box.write(tmp_path / "away" / "box.mcap", {})
    with pytest.raises(TypeError):
        box.write(tmp_path / "box.mcap", {"scene_name": object()})  # not JSON
    assert list(tmp_path.iterdir()) == []


@pytest.mark.plain
def test_the_folder_is_bounded(tmp_path: Path) -> None:
    place = tmp_path / "boxes"
    prepare_folder(place)
    assert place.stat().st_mode & 0o777 == 0o700
    for number in range(FILES_MAX + 3):
        (place / f"{number:02d}.mcap").write_bytes(b"x")
        os.utime(place / f"{number:02d}.mcap", (number, number))
    (place / "notes.txt").write_text("mine")
    (place / "link.mcap").symlink_to(tmp_path / "gone.mcap")
    prepare_folder(place)
    assert [path.name for path in list_files(place)] == [f"{n:02d}.mcap" for n in range(4, FILES_MAX + 3)]
    with (place / "20.mcap").open("wb") as file:
        file.truncate(BYTES_MAX)
    os.utime(place / "20.mcap", (20, 20))
    prepare_folder(place)
    assert [path.name for path in list_files(place)] == ["21.mcap", "22.mcap"]
    assert (place / "notes.txt").read_text() == "mine"
    place.chmod(0o777)
    with pytest.raises(ConfigError, match="other users may write to it"):
        prepare_folder(place)


def lose_device(at_tick: int) -> str:
    """Run a daemon that loses its device; return the message of the error."""
    faults = build(Faults, {"fault": [{"kind": "disconnect", "at_tick": at_tick}]}, "faults")
    with make_daemon(faults=faults) as daemon:
        daemon.start()
        with pytest.raises(DeviceLost) as lost:
            daemon.wait(WAIT_S)
    return str(lost.value)


def read_faults(path: Path) -> dict[str, dict[str, Any]]:
    events = [part.event for part in read_contents(path) if isinstance(part, Event)]
    return {event["name"]: event for event in events if event["kind"] == "fault"}


@pytest.mark.real_time
def test_a_lost_device_writes_a_file_named_in_its_event() -> None:
    error = lose_device(700)
    path = list_files(blackbox.find_folder())[-1]
    assert path.stat().st_mode & 0o777 == 0o600 and read_ticks(path) == list(range(700))
    event = read_faults(path)["device_lost"]
    assert (event["message"], event["blackbox"], event["tick"]) == (error, str(path), 699)


@pytest.mark.real_time
def test_a_killed_publisher_writes_a_file(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    # Another daemon of this process may have written a file.
    monkeypatch.setenv("SOFTFINGER_BLACKBOX_DIR", str(tmp_path))
    with make_daemon() as daemon:
        daemon.start()
        with subscribe(daemon.publisher.endpoint, timeout_s=WAIT_S) as samples:
            next(iter(samples))  # a publisher killed before it is ready is not restarted
        killed_at = daemon.servo.ticks
        os.kill(daemon.publisher.pids["telemetry"], signal.SIGKILL)
        paths = eventually(lambda: list(blackbox.find_folder().glob(f"*-{os.getpid()}-1-publisher.mcap")))
        assert daemon.publisher.restarts == 1 and daemon.servo.is_running
    (path,) = paths
    ticks = read_ticks(path)
    assert ticks == list(range(ticks[0], ticks[-1] + 1)) and ticks[0] < killed_at < ticks[-1]
    event = read_faults(path)["publisher"]
    assert "was restarted" in event["message"] and event["blackbox"] == str(path)


@pytest.mark.real_time
def test_the_error_is_the_same_without_a_folder(monkeypatch, caplog):
    monkeypatch.setenv("SOFTFINGER_BLACKBOX_DIR", "/proc/nowhere")
    lose_device(50)
    assert "/proc/nowhere" in caplog.text and "cannot be written" in caplog.text
