"""Results files: three exact formats, and a stream that can be read after a crash."""

from __future__ import annotations

from pathlib import Path
from zipfile import ZipFile

import msgspec
import numpy as np
import pytest

from softfinger.config.errors import RecordingError
from softfinger.config.files import open_recording
from softfinger.drivers.poses import decode_messages
from softfinger.proxy.record import AT, FIELDS, RECORD_SIZE, list_columns
from softfinger.server.recording.export import export
from softfinger.server.recording.results import SUFFIXES, read_results, write_blocks
from softfinger.server.recording.summary import summarize
from softfinger.server.recording.writer import RecordingFile


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
    for name in ("o.txt", "o"):
        with pytest.raises(RecordingError, match=r"\.csv, \.npz, \.mcap"):
            write_blocks(tmp_path / name, [""], [records[:, None]])
        with pytest.raises(RecordingError, match=r"\.csv, \.npz, \.mcap"):
            read_results(tmp_path / name)
    for ending in SUFFIXES:
        with pytest.raises(RecordingError, match="cannot be written"):
            write_blocks(tmp_path / "nowhere" / f"o{ending}", [""], [records[:, None]])
        with pytest.raises(RecordingError, match="cannot be read"):
            read_results(tmp_path / f"missing{ending}")
    records[1, AT.contact_mode] = np.nan
    with pytest.raises(RecordingError, match=r"record 1: contact\.mode = nan"):
        write_blocks(tmp_path / "o.mcap", [""], [records[:, None]])
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("ending", SUFFIXES)
def test_other_files_are_refused(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"other{ending}"
    path.write_bytes(b"timestamp,tick\n1,2\n")
    with pytest.raises(RecordingError, match=path.name):
        read_results(path)


def test_a_link_still_points_at_its_file(tmp_path: Path) -> None:
    (tmp_path / "real.csv").write_text("old")
    (tmp_path / "link.csv").symlink_to(tmp_path / "real.csv")
    write_blocks(tmp_path / "link.csv", [""], [make_records(2)[:, None]])
    assert (tmp_path / "link.csv").is_symlink()
    assert len(read_results(tmp_path / "real.csv")) == 2


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
