"""Damaged recordings: results are not read as the poses that they also contain; damage of MCAP files is reported."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from helpers.recorded import recorded, run
from helpers.telemetry_records import put, synthetic
from mcap.reader import make_reader
from mcap.writer import Writer

from softfinger.config.errors import RecordingError
from softfinger.proxy.record import AT
from softfinger.server import cli
from softfinger.server.recording.export import export
from softfinger.server.recording.results import read_results, write_blocks
from softfinger.server.recording.run import load_run
from softfinger.server.recording.summary import summarize

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
    # The last 8 bytes only repeat the first ones.
    for size in range(len(data) - 9, len(data) // 2, -max(1, len(data) // 200)):
        path.write_bytes(data[:size])
        assert (
            summarize(path)["cut"]
            == "it has no index at its end: it is still being written, its writer was killed, or the disk was full"
        ), size


def chunk_offsets(path: Path) -> list[int]:
    """Return the offset of the compressed bytes in the middle of each chunk."""
    with path.open("rb") as file:
        summary_ = make_reader(file).get_summary()
        assert summary_ is not None
        return [chunk.chunk_start_offset + chunk.chunk_length // 2 for chunk in summary_.chunk_indexes]


def flip(path: Path, offset: int) -> None:
    data = bytearray(path.read_bytes())
    data[offset] ^= 0xFF
    path.write_bytes(data)


def test_ticks_after_a_damaged_part_are_read(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = recorded(tmp_path / "run.mcap", run()), tmp_path / "out.npz"
    chunks = chunk_offsets(path)
    assert len(chunks) > 8
    flip(path, chunks[3])
    info = summarize(path)
    assert not info["whole"] and "a part is damaged, and its ticks are missing: " in info["cut"]
    assert (info["gaps"], info["last_tick"]) == (1, len(run()) - 1)
    assert 0 < info["missing"] == len(run()) - info["ticks"] < len(run()) // 4
    assert cli.main(["export", str(path), "--out", str(out)]) == 0
    assert f"{path} is incomplete: a part is damaged" in caplog.text
    rows = read_results(out)
    assert len(rows) == info["ticks"]
    np.testing.assert_array_equal(rows, run()[rows[:, AT.tick].astype(int)])
    assert cli.main(["info", str(path)]) == 0
    assert "incomplete: a part is damaged" in capsys.readouterr().out


def test_the_types_of_a_damaged_first_part_are_read_at_the_end(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", run())
    flip(path, chunk_offsets(path)[0])
    info = summarize(path)
    assert 0 < info["first_tick"] == len(run()) - info["ticks"] < len(run()) // 4
    assert "a part is damaged" in info["cut"]
    path.write_bytes(path.read_bytes()[:-1000])
    with pytest.raises(RecordingError, match=r"run\.mcap: has no tick: a part is damaged"):
        summarize(path)


def test_damaged_metadata_lose_no_tick(tmp_path: Path) -> None:
    path = recorded(tmp_path / "run.mcap", run())
    data = path.read_bytes()
    path.write_bytes(data.replace(b'{"fingertip": ', b'{"fingertip"; ', 1))
    info = summarize(path)
    assert info["ticks"] == len(run()) and info["rig"] is not None and info["scene"] is None
    assert "metadata 'scene' is damaged: " in info["cut"]


@pytest.mark.parametrize("device", [{}, {"name": None}, "x"])
def test_a_device_without_a_name_is_unknown(device: object, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = recorded(tmp_path / "run.mcap", run()[:10], device=device)
    assert cli.main(["info", str(path)]) == 0
    assert "device unknown" in capsys.readouterr().out


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
