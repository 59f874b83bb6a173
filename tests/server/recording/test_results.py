"""Results files: three exact formats, a stream that can be read after a crash, and damaged files."""

import re
from pathlib import Path
from zipfile import ZipFile

import msgspec
import numpy as np
import pytest
from helpers.called import read_stdout
from helpers.recorded import about, event, recorded, run
from helpers.telemetry_records import put, synthetic
from mcap.reader import make_reader
from mcap.writer import Writer

from softfinger.config.errors import RecordingError
from softfinger.config.files import open_recording
from softfinger.drivers.poses import decode_messages
from softfinger.proxy.record import AT, FIELDS, RECORD_SIZE, list_columns
from softfinger.server.recording.export import export
from softfinger.server.recording.results import SUFFIXES, read_results, write_blocks
from softfinger.server.recording.run import load_run
from softfinger.server.recording.summary import summarize
from softfinger.server.recording.writer import RecordingFile

pytestmark = pytest.mark.plain

FORCE_N = 0.123456789


def damaged(path: Path) -> tuple[int, ...]:
    """Write results, and return the places of the same force in the file."""
    records = synthetic(3)
    put(records, "tick", range(3))
    put(records, "timestamp", np.arange(3) * 0.001)
    put(records, "probe.orientation", [1.0, 0.0, 0.0, 0.0])
    put(records, "force", FORCE_N)
    write_blocks(path, [""], [records[:, None]])
    text = str(FORCE_N).encode() if path.suffix == ".csv" else np.float64(FORCE_N).tobytes()
    data = path.read_bytes()
    return tuple(at for at in range(len(data)) if data.startswith(text, at))[:9]


@pytest.mark.parametrize("place", [0, 4, 8])
@pytest.mark.parametrize("ending", [".csv", ".npz"])
def test_results_with_a_damaged_force_are_refused(ending: str, place: int, tmp_path: Path) -> None:
    path = tmp_path / f"run{ending}"
    at = damaged(path)[place]
    assert summarize(path)["fingers"]
    data = bytearray(path.read_bytes())
    data[at + 3] = ord("x")
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=f"{path.name}.*(line {place // 3 + 2}|CRC)"):
        summarize(path)


def test_a_file_cut_at_any_place_is_cut_short(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_blocks(path, [""], [synthetic(300)[:, None]])
    data = path.read_bytes()
    cut = "it has no index at its end: it is still being written, its writer was killed, or the disk was full"
    # The last 8 bytes only repeat the first ones.
    for size in range(len(data) - 9, len(data) // 2, -max(1, len(data) // 200)):
        path.write_bytes(data[:size])
        assert summarize(path)["cut"] == cut, size


def chunk_offsets(path: Path) -> list[int]:
    """Return the offset of the compressed bytes in the middle of each chunk."""
    with path.open("rb") as file:
        summary_ = make_reader(file).get_summary()
        return [chunk.chunk_start_offset + chunk.chunk_length // 2 for chunk in summary_.chunk_indexes]


def flip(path: Path, offset: int) -> None:
    data = bytearray(path.read_bytes())
    data[offset] ^= 0xFF
    path.write_bytes(data)


def test_ticks_after_a_damaged_part_are_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path, out = recorded(tmp_path / "run.mcap", run()), tmp_path / "out.npz"
    chunks = chunk_offsets(path)
    assert len(chunks) > 8
    flip(path, chunks[3])
    info = summarize(path)
    assert not info["whole"] and "a part is damaged, and its ticks are missing: " in info["cut"]
    assert (info["gaps"], info["last_tick"]) == (1, len(run()) - 1)
    assert 0 < info["missing"] == len(run()) - info["ticks"] < len(run()) // 4
    read_stdout("export", str(path), "--out", str(out))
    assert f"{path} is incomplete: a part is damaged" in caplog.text
    rows = read_results(out)
    assert len(rows) == info["ticks"]
    np.testing.assert_array_equal(rows, run()[rows[:, AT.tick].astype(int)])
    assert "incomplete: a part is damaged" in read_stdout("info", str(path))


def test_the_types_of_a_damaged_part_are_read_at_the_end(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", run())
    flip(path, chunk_offsets(path)[0])
    info = summarize(path)
    assert 0 < info["first_tick"] == len(run()) - info["ticks"] < len(run()) // 4
    assert "a part is damaged" in info["cut"]
    assert (info["missing"], info["gaps"], info["longest_gap"]) == (info["first_tick"], 1, info["first_tick"])
    for number in (-2, -1):  # they become the last part that is read, and a part at the end
        flip(path, chunk_offsets(path)[number])
    info = summarize(path)
    assert (info["missing"], info["gaps"]) == (len(run()) - info["ticks"], 2)
    assert info["longest_gap"] == max(info["first_tick"], len(run()) - 1 - info["last_tick"])
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(RecordingError, match=r"run\.mcap: has no tick: a part is damaged"):
        summarize(path)
    recording = RecordingFile((path := tmp_path / "marks.mcap").open("wb", buffering=0), ("",), about())
    for rows in (run()[:100], run()[100:]):
        recording.ticks(rows)
        recording.event(event("mark", "mark", 0, label=""))
    recording.close()
    flip(path, chunk_offsets(path)[1])  # declares the topic of the marks
    assert summarize(path)["events"] == {"mark mark": 1}


def test_damaged_metadata_lose_no_tick(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", run())
    data = path.read_bytes()
    path.write_bytes(data.replace(b'{"fingertip": ', b'{"fingertip"; ', 1))
    info = summarize(path)
    assert info["ticks"] == len(run()) and info["rig"] is not None and info["scene"] is None
    assert "metadata 'scene' is damaged: " in info["cut"]


@pytest.mark.parametrize("device", [{}, {"name": None}, "x"])
def test_a_device_without_a_name_is_unknown(device: object, tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", run()[:10], device=device)
    assert "device unknown" in read_stdout("info", str(path))


@pytest.mark.parametrize(
    ("topic", "message"),
    [
        ("/joint_states", "has no tick on topic 'contact' or 'finger/NAME': its topics are '/joint_states'"),
        ("contact", "has no tick: ValueError: messages of topic 'contact' are not protobuf"),
    ],
)
def test_a_file_of_another_program_is_named_as_such(topic: str, message: str, tmp_path: Path) -> None:
    path = tmp_path / "theirs.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema(name="x", encoding="jsonschema", data=b"{}")
        channel = writer.register_channel(topic=topic, message_encoding="json", schema_id=schema)
        writer.add_message(channel, log_time=1, data=b"{}", publish_time=1)
        writer.finish()
    for read in (summarize, lambda path: load_run(path, ()), lambda path: export(path, tmp_path / "out.csv")):
        with pytest.raises(RecordingError, match=re.escape(f"{path}: {message}")):
            read(path)
    assert list(tmp_path.iterdir()) == [path]


def make_records(count: int, seed: int = 11) -> np.ndarray:
    rng = np.random.default_rng(seed)
    records = rng.standard_normal((count, RECORD_SIZE)) * 10.0 ** rng.integers(-300, 300, (count, RECORD_SIZE))
    for field in FIELDS:
        if field.kind == "int":
            records[:, field.at] = rng.integers(-1, 2**53, count)
    records[:, AT.timestamp] = 1.7e9 + np.arange(count) / 1000.0
    if count:
        records[0, 3:9] = [-0.0, 5e-324, 1.7976931348623157e308, np.inf, -np.inf, np.nan]
    return records


@pytest.mark.parametrize("ending", SUFFIXES)
@pytest.mark.parametrize("count", [1, 2500])
def test_round_trip_is_exact(tmp_path: Path, ending: str, count: int) -> None:
    path = tmp_path / f"out{ending.upper()}"
    records = make_records(count)
    write_blocks(path, [""], [records[:, None]])
    assert read_results(path).tobytes() == records.tobytes()
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("ending", [".csv", ".npz"])
def test_no_records_is_a_valid_file(tmp_path: Path, ending: str) -> None:
    write_blocks(tmp_path / f"o{ending}", [""], [])
    assert read_results(tmp_path / f"o{ending}").shape == (0, RECORD_SIZE)


@pytest.mark.parametrize("count", [1, 7, 1100])
def test_csv_has_the_shortest_digits(tmp_path: Path, count: int) -> None:
    records = make_records(count)
    records[np.isinf(records) | np.isnan(records)] = 0.0
    records[:, 10] = 0.1
    records[::3, 11] = np.arange(len(records[::3])) * -1.0
    records[::2, 12] = -0.0
    records[:, 13] = np.resize([1e15, 9999999999999998.0, 1e16, -(2.0**53), 1e22, 1e-5], count)
    write_blocks(tmp_path / "o.csv", [""], [records[:, None]])
    rows = [[msgspec.json.encode(number).decode().removesuffix(".0") for number in row] for row in records.tolist()]
    assert (tmp_path / "o.csv").read_text().splitlines() == [",".join(row) for row in [list_columns(), *rows]]


@pytest.mark.parametrize("count", [0, 1, 9000])
def test_npz_equals_that_of_numpy(tmp_path: Path, count: int) -> None:
    records = make_records(count)
    records[:, [AT.buttons, AT.force + 1]] = 0.0
    records[5000:, AT.buttons], records[8500:, AT.force + 1] = -0.0, 1.0
    write_blocks(tmp_path / "o.npz", [""], [records[:, None]] if count else [])
    arrays = {f.name: records[:, f.at] if f.size == 1 else records[:, f.at : f.at + f.size] for f in FIELDS}
    np.savez(tmp_path / "numpys.npz", records=records, **arrays)
    with ZipFile(tmp_path / "o.npz") as ours, ZipFile(tmp_path / "numpys.npz") as numpys:
        assert ours.namelist() == numpys.namelist()
        assert all(ours.read(name) == numpys.read(name) for name in numpys.namelist())


def test_stream_can_be_read_before_it_is_closed(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    records = make_records(3000)
    path = tmp_path / "live.mcap"
    stream = RecordingFile(open_recording(path), with_pictures=False)
    for row in records:
        stream.ticks(row[None])
    copy = tmp_path / "copy.mcap"
    copy.write_bytes(path.read_bytes())
    rows = read_results(copy)
    assert 3000 - 300 < len(rows) < 3000  # 64 KiB are about 170 messages
    assert rows.tobytes() == records[: len(rows)].tobytes()
    assert "truncated" in caplog.text
    stream.close()
    stream.close()
    assert sum(1 for _ in decode_messages(path)) == 3000


def test_unusable_requests_are_refused(tmp_path: Path) -> None:
    records = make_records(3)
    suffixes = r"\.csv, \.npz, \.mcap"
    cases = [(name, name, suffixes, suffixes) for name in ("o.txt", "o")]
    cases += [(f"nowhere/o{end}", f"missing{end}", "cannot be written", "cannot be read") for end in SUFFIXES]
    for written, read, write_message, read_message in cases:
        with pytest.raises(RecordingError, match=write_message):
            write_blocks(tmp_path / written, [""], [records[:, None]])
        with pytest.raises(RecordingError, match=read_message):
            read_results(tmp_path / read)
    records[1, AT.contact_mode] = np.nan
    with pytest.raises(RecordingError, match=r"record 1: contact\.mode = nan"):
        write_blocks(tmp_path / "o.mcap", [""], [records[:, None]])
    assert list(tmp_path.iterdir()) == []
    for ending in SUFFIXES:
        path = tmp_path / f"other{ending}"
        path.write_bytes(b"timestamp,tick\n1,2\n")
        with pytest.raises(RecordingError, match=path.name):
            read_results(path)


def test_a_link_still_points_at_its_file(tmp_path: Path) -> None:
    (tmp_path / "real.csv").write_text("old")
    (tmp_path / "link.csv").symlink_to(tmp_path / "real.csv")
    write_blocks(tmp_path / "link.csv", [""], [make_records(2)[:, None]])
    assert (tmp_path / "link.csv").is_symlink() and len(read_results(tmp_path / "real.csv")) == 2


@pytest.mark.parametrize("ending", [".csv", ".npz"])
def test_results_of_several_fingers_are_summarised_and_exported(ending: str, tmp_path: Path) -> None:
    path, out = tmp_path / f"two{ending}", tmp_path / "out.npz"
    fingers = {"thumb": make_records(30), "index": make_records(30) + 1.0}
    write_blocks(path, list(fingers), [np.stack(list(fingers.values()), axis=1)])
    info = summarize(path)
    assert {name: finger["ticks"] for name, finger in info["fingers"].items()} == {"thumb": 30, "index": 30}
    for name, records in fingers.items():
        assert export(path, out, name) == 30
        np.testing.assert_array_equal(read_results(out), records)
    with pytest.raises(RecordingError, match="no ticks of a single finger: it has fingers index, thumb: --finger NAME"):
        export(path, out)


def test_poses_with_a_column_like_that_of_a_finger_are_poses(tmp_path: Path) -> None:
    path = tmp_path / "poses.csv"
    path.write_text("t,x,y,z,qw,qx,qy,qz,hand.timestamp\n0,0,0,1,1,0,0,0,5\n1,0,0,1,1,0,0,0,6\n")
    assert summarize(path)["ticks"] == 2
