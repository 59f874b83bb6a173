"""Writing of recordings: to a slow or a full disk, until a kill, and to places that a client may not choose."""

import os
import random
import resource
import signal
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from io import FileIO
from itertools import count, repeat
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers.daemons import QUIET
from helpers.processes import COMMAND
from helpers.programs import Program
from helpers.recorded import about, event, run
from helpers.shortages import file_size_limit
from helpers.waits import WAIT_S, eventually
from mcap.reader import NonSeekingReader, make_reader
from mcap_protobuf.decoder import DecoderFactory

from softfinger.config.errors import RecordingError
from softfinger.config.files import open_recording
from softfinger.config.load import load_rig, load_scene
from softfinger.drivers.poses import load_poses
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.app import Daemon
from softfinger.server.recording.poses_file import CsvPoses, open_poses_file
from softfinger.server.recording.reader import End, Event, Note, TickBlock, read_contents
from softfinger.server.recording.recorder import NEW_RECORDING_REMEDY, PERIOD_S, QUEUE_EVENTS, QUEUE_ROWS, Recorder
from softfinger.server.recording.summary import summarize
from softfinger.server.recording.writer import RecordingFile
from softfinger.server.wire.client import subscribe

pytestmark = pytest.mark.real_time

LOST_MAX_TICKS = 200
"""Promised maximum after a kill, at 1 kHz: four times the delay of an idle recorder."""


def quiet_rig(folder: Path, **changes: Any) -> Any:
    return load_rig("replay", QUIET | {"device.recording": "tap", "recording.directory": str(folder)} | changes)


def read(path: Path) -> tuple[np.ndarray, list[dict[str, Any]], dict[str, Any], End]:
    parts = list(read_contents(path))
    ticks = [part.records() for part in parts if isinstance(part, TickBlock)]
    notes = {part.name: part.value for part in parts if isinstance(part, Note)}
    events = [part.event for part in parts if isinstance(part, Event)]
    return np.concatenate(ticks), events, notes, parts[-1]


NOT_BELOW = {
    "/tmp/x.mcap": "not absolute",
    "../x.mcap": r"without \.\.",
    "in/../../x.mcap": r"without \.\.",
    "link/x.mcap": "Not a directory|Too many levels",
    "there.mcap": "already exists",
    "dangling.mcap": "already exists",
    "nowhere/x.mcap": "No such file",
    "x.csv": r"must end in \.mcap",
    "x\0.mcap": "null byte",
}


def test_a_client_writes_below_the_folder_only(tmp_path: Path) -> None:
    from softfinger.server.services.recordings import _open_new_file

    folder = tmp_path / "recordings"
    folder.mkdir()
    (folder / "in").mkdir()
    (folder / "link").symlink_to(tmp_path)
    (folder / "dangling.mcap").symlink_to(tmp_path / "x.mcap")
    (folder / "there.mcap").write_text("precious")
    before = sorted(tmp_path.rglob("*"))
    with Daemon(quiet_rig(folder), load_scene("paper-plane")) as daemon:
        for name, why in NOT_BELOW.items():
            with pytest.raises(RecordingError, match=why):
                daemon.recordings.begin(name, "paper-plane")
    assert sorted(tmp_path.rglob("*")) == before and (folder / "there.mcap").read_text() == "precious"
    with _open_new_file(Path("in/x.mcap"), folder) as file:
        file.write(b"x")
    assert (folder / "in" / "x.mcap").read_bytes() == b"x"


@pytest.mark.sampled(1)
@pytest.mark.parametrize("seed", [1, 2])
def test_a_kill_loses_little(seed: int, tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    endpoint = f"ipc://{tmp_path}/t"
    words = ["run", "--endpoint", endpoint, "--commands", "off", "--realtime", "off", "--record", str(path)]
    with (
        Program([*COMMAND, *words], stderr=subprocess.DEVNULL) as process,
        subscribe(endpoint, timeout_s=WAIT_S) as samples,
    ):
        enough = random.Random(seed).randrange(300, 900)
        last_tick = next(samples).tick
        while last_tick < enough:
            last_tick = next(samples).tick
        process.kill()
        process.wait()
        while (sample := samples.receive(0.2)) is not None:
            last_tick = sample.tick
    ticks = []
    with path.open("rb") as file:
        reader = NonSeekingReader(file, decoder_factories=[DecoderFactory()])
        try:
            for _, channel, _, decoded in reader.iter_decoded_messages(log_time_order=False):
                if channel.topic == "contact":
                    ticks.append(decoded.tick)
        except Exception:  # of many classes, if a chunk is torn
            pass
    assert ticks == list(range(len(ticks))) and ticks[-1] >= last_tick - LOST_MAX_TICKS
    report = summarize(path)
    assert not report["whole"] and report["ticks"] == len(ticks) and report["scene_name"] == "paper-plane"


class SlowFile(FileIO):
    """File on a disk that blocks writes while `free` is not set."""

    def __init__(self, path: Path) -> None:
        super().__init__(path, "w")
        self.free, self.writing = threading.Event(), threading.Event()
        self.free.set()

    def write(self, data: Any) -> int:
        if not self.free.is_set():
            self.writing.set()
            self.free.wait()
        return super().write(data)


@contextmanager
def stalled(path: Path, batches: Iterator[np.ndarray]) -> Iterator[tuple[Recorder, SlowFile, list[str]]]:
    """Yield a recorder that has written one batch and waits for the disk with the next; its file, and its reports."""
    file, reports = SlowFile(path), list[str]()
    recorder = Recorder(file, [""], about(), lambda text, _: reports.append(text))
    recorder.ticks(first := next(batches))
    assert eventually(lambda: recorder.recorded.ticks == len(first))
    file.free.clear()
    recorder.ticks(next(batches))
    assert file.writing.wait(WAIT_S)
    yield recorder, file, reports


def test_a_stalled_disk_drops_events_and_counts_them(tmp_path: Path) -> None:
    with stalled(tmp_path / "slow.mcap", repeat(run()[:1])) as (recorder, file, reports):
        start_s = time.monotonic()
        for number in range(QUEUE_EVENTS + 30):
            recorder.event(event("mark", f"mark {number}", number))
        recorder.note("last", {"said": True})
        assert recorder.recorded.events_dropped == 30
        stalled_s = time.monotonic() - start_s
        file.free.set()
        assert eventually(lambda: reports)
        recorded_ = recorder.stop(WAIT_S)
    assert recorded_.whole and recorded_.events_dropped == 30 and recorded_.worst_write_s >= stalled_s
    assert reports == ["30 events were not recorded: the disk was too slow"]
    _, events, notes, _ = read(tmp_path / "slow.mcap")
    assert [entry["name"] for entry in events] == [f"mark {number}" for number in range(QUEUE_EVENTS)]
    assert notes["end"]["events_dropped"] == 30 and notes["last"] == {"said": True}
    assert summarize(tmp_path / "slow.mcap")["events_dropped"] == 30


def make_batches() -> Iterator[np.ndarray]:
    """Yield batches of 1024 ticks that follow each other."""
    for first in count(0, 1024):
        batch = np.tile(run()[:1], (1024, 1))
        batch[:, AT.tick] = first + np.arange(1024)
        yield batch


def test_a_stalled_disk_loses_ticks_but_delays_nothing(tmp_path: Path) -> None:
    batches, dropped = make_batches(), 1024 * 10
    with stalled(tmp_path / "slow.mcap", batches) as (recorder, file, reports):
        while not recorder.recorded.dropped:  # without waiting
            recorder.ticks(batch := next(batches))
            assert batch[-1, AT.tick] <= 1024 + 2 * QUEUE_ROWS
        for _ in range(9):
            recorder.ticks(next(batches))
        assert recorder.recorded.dropped == dropped
        file.free.set()
        assert eventually(lambda: reports)
        recorder.ticks(last := next(batches))
        recorded_ = recorder.stop(WAIT_S)
    assert recorded_.whole and recorded_.dropped == dropped
    records, _, notes, end = read(tmp_path / "slow.mcap")
    assert end.cut == "" and notes["end"] == {"ticks": len(records), "dropped": dropped, "events_dropped": 0}
    assert records[-1, AT.tick] == last[-1, AT.tick] == len(records) + dropped - 1
    (at,) = np.flatnonzero(np.diff(records[:, AT.tick]) != 1.0)
    first = int(records[at, AT.tick]) + 1
    assert reports == [f"{dropped} ticks from tick {first} on were not recorded: the disk was too slow"]
    info = summarize(tmp_path / "slow.mcap")
    assert (info["missing"], info["gaps"], info["longest_gap"], info["dropped"]) == (dropped, 1, dropped, dropped)


def test_a_full_disk_is_one_event_and_the_run_continues(tmp_path: Path) -> None:
    with (
        Daemon(quiet_rig(tmp_path), load_scene("paper-plane")) as daemon,
        subscribe(daemon.publisher.endpoint, ("event",)) as wire,
    ):
        daemon.start()
        assert eventually(lambda: daemon.publisher.figures.subscribers == 1)  # earlier events reach no subscriber
        daemon.recordings.begin("a.mcap", "paper-plane")
        recorder = daemon.recordings._recorder
        assert eventually(lambda: recorder.recorded.ticks > 100)
        full = os.open("/dev/full", os.O_WRONLY)
        os.dup2(full, recorder._file.fileno())
        os.close(full)
        assert eventually(lambda: recorder.recorded.error)
        ticks = daemon.servo.ticks
        daemon.recordings.begin("b.mcap", "paper-plane")
        assert eventually(lambda: daemon.servo.ticks > ticks + 200)
        daemon.stop()
        assert daemon.wait(60.0)
        daemon.publisher.event("test", "done")
        faults = []
        while (sample := wire.receive(10.0)) is not None and sample["kind"] != "test":
            faults += [sample.data] if sample["kind"] == "fault" else []
        with pytest.raises(RecordingError, match=r"a\.mcap: the recording ends after \d+ ticks: No space left"):
            daemon.close()
    (fault,) = faults
    assert fault["name"] == "recording" and "No space left" in fault["message"] and "a.mcap" in fault["message"]
    records, _, _, end = read(tmp_path / "a.mcap")
    assert end.cut and len(records) > 100
    assert summarize(tmp_path / "b.mcap")["whole"]


def test_a_failed_recording_sets_the_exit_code_of_the_run(tmp_path: Path) -> None:
    path = tmp_path / "cut.mcap"
    command = [*COMMAND, "run", "--realtime", "off", "--endpoint", f"ipc://{tmp_path}/t", "--record", str(path)]
    with Program(command, stderr=subprocess.PIPE, text=True) as process:
        with subscribe(f"ipc://{tmp_path}/t", timeout_s=WAIT_S) as samples:
            assert next(sample for sample in samples if sample.tick > 200)  # it runs and has written
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (path.stat().st_size, resource.RLIM_INFINITY))
        lines = []
        for line in process.stderr:
            lines.append(line)
            if "the recording ends" in line:
                break
        process.send_signal(signal.SIGINT)
        rest = process.stderr.read()
        assert process.wait(WAIT_S) == RecordingError.exit_code, "".join(lines) + rest
    assert str(path) in lines[-1] and "File too large" in lines[-1]
    assert "force is zero" in rest
    (error,) = [line for line in rest.splitlines() if str(path) in line]
    assert "File too large" in error and "Traceback" not in rest


def ticks_by_library(path: Path) -> list[int]:
    with path.open("rb") as file:
        messages = make_reader(file, decoder_factories=[DecoderFactory()]).iter_decoded_messages("contact")
        return [decoded.tick for _, _, _, decoded in messages]


def open_recorder(path: Path) -> tuple[Recorder, list[str]]:
    """Return a recorder, and its reports."""
    reports: list[str] = []
    return Recorder(open_recording(path), [""], about(), lambda text, _: reports.append(text)), reports


def test_a_file_that_may_not_grow_ends_whole_chunks(tmp_path: Path) -> None:
    path, rows = tmp_path / "limited.mcap", run()  # compiled before: the limit also applies to the kernel cache
    with file_size_limit(40_000):
        recorder, reports = open_recorder(path)
        for first in range(0, 2000, 40):
            recorder.ticks(rows[first : first + 40])
            time.sleep(PERIOD_S / 20)
        assert eventually(lambda: reports)
    assert "File too large" in recorder.recorded.error
    (report,) = reports
    assert report.endswith(f"File too large: {NEW_RECORDING_REMEDY}")
    records, _, _, end = read(path)
    assert 100 < recorder.recorded.ticks == len(records) < 2000 and end.cut.startswith("it has no index at its end")
    assert path.stat().st_size == recorder.recorded.bytes <= 40_000
    assert records.tobytes() == rows[: len(records)].tobytes()
    assert ticks_by_library(path) == records[:, AT.tick].tolist()


def test_a_disk_without_room_for_the_index_loses_no_tick(tmp_path: Path) -> None:
    path, rows = tmp_path / "limited.mcap", run()
    recorder, _ = open_recorder(path)
    recorder.ticks(rows)
    assert eventually(lambda: recorder.recorded.ticks == len(rows))
    with file_size_limit(path.stat().st_size + 1000):  # room for the end of the data, not for the schemas of the index
        assert "File too large" in recorder.stop(WAIT_S).error
    records, _, notes, end = read(path)
    assert records.tobytes() == rows.tobytes() and end.cut and notes["end"]["ticks"] == recorder.recorded.ticks
    assert path.stat().st_size == recorder.recorded.bytes
    assert ticks_by_library(path) == records[:, AT.tick].tolist()


@pytest.mark.parametrize("limit", [0, 4, 1000, 2000])
def test_a_recording_without_a_tick_leaves_no_file(limit: int, tmp_path: Path) -> None:
    """The limits are in the first bytes, in the description, and in the first chunk."""
    rows = run()
    with file_size_limit(limit):
        recorder, reports = open_recorder(tmp_path / "limited.mcap")
        recorder.ticks(rows)
        assert eventually(lambda: reports)
        assert recorder.stop(WAIT_S).ticks == 0
    assert reports == [f"the recording ends after 0 ticks: File too large: {NEW_RECORDING_REMEDY}"]
    assert list(tmp_path.iterdir()) == []


def test_poses_on_a_full_disk_end_with_a_whole_line(tmp_path: Path) -> None:
    path, records = tmp_path / "poses.csv", np.zeros((1, RECORD_SIZE))
    records[0, [AT.probe_position + 2, AT.probe_orientation]] = 1 / 3, 1.0
    file, lines = CsvPoses(path), list[int]()

    def add_all() -> None:
        for number in range(100):
            file.add(np.array([number * 1e-3]), records)
            lines.append(path.read_bytes().count(b"\n"))  # a kill loses no written line

    with file_size_limit(1000), pytest.raises(RecordingError, match=r"poses\.csv: cannot be written: File too large"):
        add_all()
    file.close()
    poses = load_poses(path)
    assert lines == list(range(2, len(lines) + 2)) and len(poses.t) == len(lines) > 10
    assert (poses.position[:, 2] == 1 / 3).all()


def test_results_on_a_full_disk_end_with_whole_chunks(tmp_path: Path) -> None:
    path, rows = tmp_path / "poses.mcap", run()
    results = RecordingFile(open_recording(path), with_pictures=False)
    with file_size_limit(40_000), pytest.raises(OSError, match="File too large"):
        results.ticks(rows)
    written = results.count()
    results.close()
    ticks = ticks_by_library(path)  # with an index, because the end finds room
    assert summarize(path)["whole"] and 100 < len(ticks) == written < len(rows)


@pytest.mark.parametrize("name", ["poses.csv", "poses.mcap"])
@pytest.mark.parametrize("limit", [0, 10])
def test_poses_without_a_row_leave_no_file(name: str, limit: int, tmp_path: Path) -> None:
    with file_size_limit(limit), pytest.raises(RecordingError, match=f"{name}: cannot be written: File too large"):
        open_poses_file(tmp_path / name)
    assert list(tmp_path.iterdir()) == []
