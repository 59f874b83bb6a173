"""Files that somebody made to do harm: pipes, devices, bombs, planted links. One error, at once, in little memory."""

import os
import socket
import struct
import sys
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import lz4.frame
import numpy as np
import pytest
import zstandard
from helpers.programs import run_program
from helpers.shortages import file_size_limit
from helpers.waits import ends_within

from softfinger.config import files
from softfinger.config.arrays import grids
from softfinger.config.arrays.grids import read_grid
from softfinger.config.errors import ConfigError, DeviceError, HapticError, RecordingError
from softfinger.config.load import load_rig, load_scene
from softfinger.drivers import poses
from softfinger.drivers.falcon import firmware
from softfinger.drivers.poses import load_poses
from softfinger.proxy.record import RECORD_SIZE
from softfinger.server.recording import results
from softfinger.server.recording.compare import READ_FIELDS
from softfinger.server.recording.poses_file import McapPoses
from softfinger.server.recording.results import read_results, write_blocks
from softfinger.server.recording.run import load_run
from softfinger.server.recording.summary import summarize
from softfinger.tools.doctor import report
from softfinger.tools.sweep import open_rows

pytestmark = pytest.mark.plain

STRANGER = 54321
HANGS_S = 60
"""Longer than any of these takes on a busy machine; a read of a pipe never ends."""
GROWTH_MAX_MB = 400
"""The largest limit in drivers/mcap_messages.py and drivers/poses.py is 160 MB, an array may exist twice, and zstd has
a window of up to 128 MB. Each bomb is larger."""


@pytest.fixture(autouse=True)
def _no_waiting() -> Iterator[None]:
    with ends_within(HANGS_S):
        yield


def open_sweep(path: Path) -> None:
    with open_rows(path):
        pass


INPUTS: dict[str, tuple[Callable[[Path], object], str, type[HapticError]]] = {
    "scene": (load_scene, ".toml", ConfigError),
    "rig": (load_rig, ".toml", ConfigError),
    **{f"poses{end}": (load_poses, end, RecordingError) for end in poses.ENDINGS},
    **{f"results{end}": (read_results, end, RecordingError) for end in results.SUFFIXES},
    "recording": (summarize, ".mcap", RecordingError),
    "run": (lambda path: load_run(path, READ_FIELDS), ".mcap", RecordingError),
    **{f"grid{end}": (read_grid, end, ConfigError) for end in grids.READERS},
    "sweep": (open_sweep, ".mcap", RecordingError),
    "firmware": (lambda path: firmware._read_firmware(str(path)), ".bin", DeviceError),
}
"""Everything that reads a file that a user names: how, its ending, its error."""


def make_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(path))


@pytest.mark.parametrize("make", [os.mkfifo, lambda path: path.symlink_to("/dev/zero"), make_socket, Path.mkdir])
@pytest.mark.parametrize("kind", INPUTS)
def test_only_regular_files_are_read(tmp_path, monkeypatch, kind, make):
    monkeypatch.chdir(tmp_path)  # a socket's path has to be short
    read, ending, error = INPUTS[kind]
    path = Path(f"odd{ending}")
    make(path)
    with pytest.raises(error, match=f"odd{ending}"):
        read(path)


LARGE = 1 << 30


def mcap_of(compression: str, data: bytes, size: int) -> bytes:
    """Return an MCAP file with one chunk that claims to unpack to `size` bytes."""

    def text(value: str) -> bytes:
        return struct.pack("<I", len(value)) + value.encode()

    header = text("") + text("")
    chunk = struct.pack("<QQQI", 0, 0, size, 0) + text(compression) + struct.pack("<Q", len(data)) + data
    parts = [struct.pack("<BQ", kind, len(body)) + body for kind, body in ((1, header), (6, chunk))]
    return b"\x89MCAP0\r\n" + b"".join(parts)


def zstd_zeros(known: bool) -> bytes:
    made = zstandard.ZstdCompressor().compressobj(size=LARGE if known else -1)
    return b"".join(made.compress(bytes(1 << 20)) for _ in range(LARGE >> 20)) + made.flush()


def lz4_zeros(known: bool) -> bytes:
    made = lz4.frame.LZ4FrameCompressor()
    begun = made.begin(source_size=LARGE if known else 0)
    return begun + b"".join(made.compress(bytes(1 << 20)) for _ in range(LARGE >> 20)) + made.flush()


def npz_of_claims(path: Path) -> None:
    with zipfile.ZipFile(path, "w") as archive, archive.open("timestamp.npy", "w") as member:
        np.lib.format.write_array_header_1_0(member, {"descr": "<f8", "fortran_order": False, "shape": (1 << 45,)})


def csv_without_lines(path: Path) -> None:
    with path.open("wb") as file:
        file.truncate(4 * LARGE)


BOMBS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "zstd": (".mcap", lambda path: path.write_bytes(mcap_of("zstd", zstd_zeros(True), LARGE))),
    "zstd of unknown size": (".mcap", lambda path: path.write_bytes(mcap_of("zstd", zstd_zeros(False), LARGE))),
    "lz4": (".mcap", lambda path: path.write_bytes(mcap_of("lz4", lz4_zeros(True), LARGE))),
    "npz header": (".npz", npz_of_claims),
    "csv line": (".csv", csv_without_lines),
}

GROWTH = """
import resource, sys
from pathlib import Path
from softfinger.config.errors import HapticError
from softfinger.drivers.poses import load_poses
from softfinger.server.recording.results import read_results
def peak():
    return int(next(line for line in open("/proc/self/status") if line.startswith("VmHWM")).split()[1]) // 1024
before = peak()
for path in sys.argv[1:]:
    for read in (load_poses, read_results):
        try:
            read(Path(path))
            sys.exit(f"{path} was read")
        except HapticError as error:
            print(peak() - before, error)
"""


def test_bombs_are_refused_in_little_memory(tmp_path: Path) -> None:
    paths = []
    for name, (ending, make) in BOMBS.items():
        paths.append(tmp_path / f"{name}{ending}")
        make(paths[-1])
    process = run_program([sys.executable, "-c", GROWTH, *map(str, paths)], timeout=HANGS_S, check=True)
    lines = process.stdout.splitlines()
    assert len(lines) == 2 * len(paths)
    for line, path in zip(lines, np.repeat(paths, 2), strict=True):
        grown, _, error = line.partition(" ")
        assert int(grown) < GROWTH_MAX_MB, line  # of all files so far
        assert path.name in error


def some_records(count: int) -> np.ndarray:
    records = np.zeros((count, RECORD_SIZE))
    records[:, 0] = np.arange(count)
    return records


@pytest.mark.parametrize("ending", poses.ENDINGS)
def test_more_rows_than_the_limit_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str) -> None:
    path = tmp_path / f"long{ending}"
    write_blocks(path, [""], [some_records(5)[:, None]])
    monkeypatch.setattr(poses, "POSES_MAX", 4)
    monkeypatch.setattr(results, "RESULTS_MAX", 4)
    for read in (load_poses, read_results):
        with pytest.raises(RecordingError, match=f"long{ending}: more than 4 "):
            read(path)
    monkeypatch.setattr(results, "RESULTS_MAX", 5)
    assert len(read_results(path)) == 5


def write_sweep(path: Path) -> None:
    with open_rows(path) as rows:
        rows.append([("k", 1, 2)])


def stream(path: Path) -> None:
    file = McapPoses(path)
    file.add(np.zeros(1), some_records(1))
    file.close()


OUTPUTS: dict[str, Callable[[Path], object]] = {
    "o.csv": lambda path: write_blocks(path, [""], [some_records(2)[:, None]]),
    "o.npz": lambda path: write_blocks(path, [""], [some_records(2)[:, None]]),
    "o.mcap": lambda path: write_blocks(path, [""], [some_records(2)[:, None]]),
    "live.mcap": stream,
    "sweep.mcap": write_sweep,
    "report.json": lambda path: report.write(path, {"a": 1}, "--probe"),
}


@pytest.mark.parametrize("name", OUTPUTS)
def test_no_planted_name_is_written_through(tmp_path: Path, name: str) -> None:
    victim = tmp_path / "victim"
    victim.write_text("precious")
    for planted in (f".{name}.part", f"{name}.part", f"{name}.lock", f"{name}.tmp"):
        (tmp_path / planted).symlink_to(victim)
    OUTPUTS[name](tmp_path / name)
    assert (tmp_path / name).stat().st_size > 0
    assert victim.read_text() == "precious"
    assert len(list(tmp_path.iterdir())) == 6


@pytest.mark.skipif(os.geteuid() != 0, reason="makes links of another user")
@pytest.mark.parametrize("name", OUTPUTS)
def test_a_link_of_another_user_is_not_written_through(tmp_path: Path, name: str) -> None:
    shared, victim = tmp_path / "shared", tmp_path / "victim"
    shared.mkdir()
    shared.chmod(0o1777)
    victim.write_text("precious")
    (shared / name).symlink_to(victim)
    os.lchown(shared / name, STRANGER, STRANGER)
    with pytest.raises(HapticError, match=name):
        OUTPUTS[name](shared / name)
    assert victim.read_text() == "precious"


@pytest.mark.parametrize("make", [os.mkfifo, make_socket, Path.mkdir])
@pytest.mark.parametrize("name", OUTPUTS)
def test_only_regular_files_are_replaced(tmp_path, monkeypatch, name, make):
    """A pipe is not waited for either. A device is not tried: as root, a program once replaced /dev/null by a file."""
    monkeypatch.chdir(tmp_path)
    make(Path(name))
    Path("link" + name).symlink_to(name)
    kind = Path(name).lstat().st_mode
    for output in (name, "link" + name):
        with pytest.raises(HapticError, match=output):
            OUTPUTS[name](Path(output))
    assert Path(name).lstat().st_mode == kind and sorted(os.listdir()) == ["link" + name, name]


def test_a_failed_write_leaves_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / "o.csv"
    path.write_text("before")
    with file_size_limit(1000):
        with pytest.raises(RecordingError, match=r"o\.csv: cannot be written: File too large"):
            write_blocks(path, [""], [some_records(100)[:, None]])
        with pytest.raises(OSError, match=r"File too large: .*o\.csv"), files.write_new_file(path) as file:
            file.write(bytes(2000))
        with pytest.raises(OSError, match=r"No such file .*no/o\.csv"), files.write_new_file(tmp_path / "no" / "o.csv"):
            pass
    assert path.read_text() == "before" and list(tmp_path.iterdir()) == [path]


def test_reading_a_growing_file_is_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    path.write_bytes(bytes(100))
    assert files.read_input(path, 100) == bytes(100)
    with pytest.raises(OSError, match="has 100 bytes, at most 99 are allowed"):
        files.read_input(path, 99)
    with pytest.raises(OSError, match="has more than 99 bytes"):
        files.read_input("/proc/self/status", 99)
