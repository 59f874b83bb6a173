"""Damaged recordings: tables of results are not read as the poses that they contain, too; cut MCAP files say so."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers.telemetry_records import put, synthetic

from softfinger.config.errors import RecordingError
from softfinger.server.recording.results import write_blocks
from softfinger.server.recording.summary import summary

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
    assert summary(path)["fingers"]
    data = bytearray(path.read_bytes())
    data[at + 3] = ord("x")
    path.write_bytes(data)
    with pytest.raises(RecordingError, match=f"{path.name}.*(line {place // 3 + 2}|CRC)"):
        summary(path)


def test_a_file_cut_at_any_place_is_cut_short(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    write_blocks(path, [""], [synthetic(300)[:, None]])
    data = path.read_bytes()
    # The last 8 bytes only repeat the first ones.
    for size in range(len(data) - 9, len(data) // 2, -max(1, len(data) // 200)):
        path.write_bytes(data[:size])
        assert summary(path)["cut"] == "it has no index at its end: its writer was killed, or the disk was full", size
