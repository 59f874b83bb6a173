"""Results: one record a tick, written to and read from .csv, .npz and .mcap without losing a bit.

All three follow from the record table: CSV has a column per component, npz an array per field, and
MCAP a protobuf message whose dotted names become nested messages. The message type is built at run
time and travels inside the file, so any MCAP reader can decode it.

Of several fingers the names of columns and arrays begin with the finger's, as in `thumb.force[0]`, and MCAP has a
topic for each, `finger/thumb`.
"""

from __future__ import annotations

import logging
import math
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from itertools import groupby, repeat
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any, Final
from zipfile import ZIP_DEFLATED, ZipFile

import msgspec
import numpy as np
from numpy.typing import NDArray

from softfinger.config.arrays.npz import open_npz
from softfinger.config.errors import RecordingError
from softfinger.config.files import followed, new_file, open_input, open_output
from softfinger.drivers.poses import LINE_MAX
from softfinger.proxy.record import FIELDS, RECORD_SIZE, Field, columns
from softfinger.server.closing import Closing
from softfinger.server.progress import progress
from softfinger.server.recording.reader import End, Ticks, contents
from softfinger.server.recording.writer import RecordingFile
from softfinger.server.wire.protocol import contact_topic

Array = NDArray[np.float64]

ENDINGS: Final = (".csv", ".npz", ".mcap")
BLOCK_ROWS: Final = 2_000
RESULTS_MAX: Final = 2_000_000
"""Records read at most: 33 minutes at 1 kHz, 3 GB."""
CSV_ROWS: Final = 500
"""Rows made into text at a time: what a processor keeps at hand."""
WHOLE_MAX: Final = 1e16
"""Whole numbers from here on are written with an exponent."""
PROGRESS_MIN_ROWS: Final = 50_000  # about a second of writing; below, a bar would only flash

_JSON: Final = msgspec.json.Encoder()
_MINUS_ZERO: Final = msgspec.Raw(b"-0")

log: Final = logging.getLogger(__name__)


def write_results(path: str | Path, records: Array | Mapping[str, Array]) -> None:
    """Write records (n, RECORD_SIZE) in the format named by the ending; RecordingError when it cannot be done.

    Of several fingers: records of each by its name, as many of each.
    The file appears whole or not at all. Long writes show their progress when stderr is a terminal.
    """
    given = records if isinstance(records, Mapping) else {"": records}
    fingers = {name: np.asarray(each, dtype=np.float64) for name, each in given.items()}
    for each in fingers.values():
        if each.ndim != 2 or each.shape[1] != RECORD_SIZE:
            raise RecordingError(f"{path}: records of shape {each.shape}, must be (n, {RECORD_SIZE})")
    write_blocks(path, list(fingers), _blocks(list(fingers.values()), Path(path).suffix[1:]))


def write_blocks(path: str | Path, fingers: Sequence[str], blocks: Iterable[Array]) -> None:
    """Write records that come in blocks (m, fingers, RECORD_SIZE), of which only one is in memory at a time.

    In all else as `write_results`; what the blocks raise is raised, and then there is no file.
    """
    target = Path(path)
    writer = {".csv": _write_csv, ".npz": _write_npz, ".mcap": _write_mcap}.get(target.suffix.lower())
    if writer is None:
        raise RecordingError(_unknown_ending(target))
    try:
        with new_file(target) as file:
            writer(target, file, fingers, blocks)
    except OSError as error:
        raise RecordingError(f"{target}: cannot be written: {error.strerror or error}") from error


def read_results(path: str | Path, finger: str = "") -> Array:
    """Read records (n, RECORD_SIZE) as `write_results` wrote them, of several fingers those of `finger`.

    Raises RecordingError when they cannot be read.
    """
    source = Path(path)
    reader = {".csv": _read_csv, ".npz": _read_npz, ".mcap": _read_mcap}.get(source.suffix.lower())
    if reader is None:
        raise RecordingError(_unknown_ending(source))
    try:
        return reader(source, finger)
    except OSError as error:
        raise RecordingError(f"{source}: cannot be read: {error.strerror or error}") from error


def _check_count(path: Path, count: int) -> None:
    if count > RESULTS_MAX:
        raise RecordingError(f"{path}: more than {RESULTS_MAX:,} records, the most that are read")


def _unknown_ending(path: Path) -> str:
    seen = f"'{path.suffix}'" if path.suffix else "no ending"
    return f"{path}: {seen} names no results format: use one of {', '.join(ENDINGS)}"


def _of(finger: str) -> str:
    """What names of columns and arrays begin with."""
    return f"{finger}." if finger else ""


def _write_csv(path: Path, file: IO[bytes], fingers: Sequence[str], blocks: Iterable[Array]) -> None:
    file.write((",".join(_of(name) + column for name in fingers for column in columns()) + "\n").encode())
    for block in blocks:
        file.write(csv_lines(block.reshape(len(block), -1)))


def csv_lines(rows: Array) -> bytes:
    """Rows (n, width) as lines of CSV, from which every float64 comes back to the bit."""
    return b"".join(_some_lines(rows[at : at + CSV_ROWS]) for at in range(0, len(rows), CSV_ROWS))


def _some_lines(rows: Array) -> bytes:
    """As JSON the shortest digits that bring a number back, written several times as fast as by Python."""
    if not np.isfinite(rows).all():
        line = ",".join(repeat("%.17g", rows.shape[1])) + "\n"  # 17 digits bring every float64 back
        return "".join([line % tuple(row) for row in rows.tolist()]).encode()
    across = np.array(rows.T, order="C")
    bits = across.view(np.int64)
    still = (bits == bits[:, :1]).all(axis=1)
    # JSON gives a whole number `.0` unless it is an integer, and no integer is -0.
    whole = (np.rint(across) == across) & (np.abs(across) < WHOLE_MAX)
    odd = whole.any(axis=1).tolist()
    columns: list[Iterable[Any]] = []
    for same, group in groupby(range(len(across)), still.tolist().__getitem__):
        if same:  # what stays as it is for all rows is written once
            text = _JSON.encode(across[list(group), 0].tolist())[1:-1] + b","
            columns.append(repeat(msgspec.Raw(text.replace(b".0,", b",")[:-1]), len(rows)))
        else:
            columns.extend(_with_integers(across[at], whole[at]) if odd[at] else across[at].tolist() for at in group)
    return _JSON.encode_lines(list(zip(*columns, strict=True))).translate(None, b"[]")


def _with_integers(column: Array, whole: NDArray[np.bool_]) -> list[Any]:
    """The numbers of a column (n,), whole ones without `.0` in JSON."""
    numbers: list[Any] = column.tolist()
    for row in whole.nonzero()[0].tolist():
        numbers[row] = int(numbers[row]) or (_MINUS_ZERO if math.copysign(1.0, numbers[row]) < 0.0 else 0)
    return numbers


def _read_csv(path: Path, finger: str) -> Array:
    try:
        with open_input(path) as file:
            header = file.readline(LINE_MAX).decode("ascii").rstrip("\n").split(",")
            wanted = [_of(finger) + column for column in columns()]
            first = header.index(wanted[0]) if wanted[0] in header else 0
            if header[first : first + RECORD_SIZE] != wanted or len(header) % RECORD_SIZE:
                raise RecordingError(f"{path}, line 1: not the columns of this version's results{_whose(finger)}")
            values = array("d")
            while line := file.readline(LINE_MAX):
                cells = line.split(b",")
                if len(cells) != len(header):
                    raise ValueError(f"a line of {len(cells)} numbers, must be {len(header)}")
                values.extend(map(float, cells[first : first + RECORD_SIZE]))
                _check_count(path, len(values) // RECORD_SIZE)
        return np.array(values, dtype=np.float64).reshape(-1, RECORD_SIZE)
    except ValueError as error:
        raise RecordingError(f"{path}: not a results file: {error}") from error


def _whose(finger: str) -> str:
    return f" of a finger '{finger}'" if finger else ""


def _write_npz(path: Path, file: IO[bytes], fingers: Sequence[str], blocks: Iterable[Array]) -> None:
    """An array per field, and all of them once more as `records`. The arrays of an archive stand one behind the other,
    so the blocks wait in a file that has no name."""
    with (
        TemporaryFile(dir=followed(path).parent) as file_of_fields,
        ZipFile(file, "w", ZIP_DEFLATED, compresslevel=1) as archive,
    ):
        waiting = _Fields(file_of_fields, len(fingers))
        for block in blocks:
            waiting.put(block)
        for place, finger in enumerate(fingers):
            _add_array(archive, _of(finger) + "records", (waiting.count, RECORD_SIZE), waiting.rows(place))
            for f in FIELDS:
                shape = (waiting.count, f.size)[: 2 if f.size > 1 else 1]
                _add_array(archive, _of(finger) + f.name, shape, waiting.field(place, f))


class _Fields:
    """Blocks of records in a file, each as columns: one field of one finger behind the other."""

    def __init__(self, file: IO[bytes], fingers: int) -> None:
        self._file, self._fingers = file, fingers
        self._lengths: list[int] = []

    @property
    def count(self) -> int:
        return sum(self._lengths)

    def put(self, block: Array) -> None:
        """Add a block (m, fingers, RECORD_SIZE)."""
        self._lengths.append(len(block))
        for place in range(self._fingers):
            for f in FIELDS:
                self._file.write(np.ascontiguousarray(block[:, place, f.at : f.at + f.size]).data)

    def field(self, place: int, f: Field) -> Iterator[Array]:
        """Of each block the columns (m, size) of a field of a finger."""
        at, row = 0, 8 * RECORD_SIZE
        for length in self._lengths:
            self._file.seek(at + length * (place * row + 8 * f.at))
            yield np.frombuffer(self._file.read(8 * length * f.size)).reshape(length, f.size)
            at += length * self._fingers * row

    def rows(self, place: int) -> Iterator[Array]:
        """Of each block the records (m, RECORD_SIZE) of a finger."""
        for parts in zip(*(self.field(place, f) for f in FIELDS), strict=True):
            yield np.concatenate(parts, axis=1)


def _add_array(archive: ZipFile, name: str, shape: tuple[int, ...], blocks: Iterable[Array]) -> None:
    with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
        np.lib.format.write_array_header_1_0(member, {"descr": "<f8", "fortran_order": False, "shape": shape})
        for block in blocks:
            member.write(block.data.cast("B"))


def _read_npz(path: Path, finger: str) -> Array:
    try:
        with open_input(path) as file:
            records = open_npz(file)[_of(finger) + "records"]
    except OSError:
        raise
    except Exception as error:  # zip and npy decoders fail in many ways on damaged bytes
        raise RecordingError(f"{path}: not a results file: {type(error).__name__}: {error}") from error
    _check_count(path, len(records) if records.ndim else 0)
    if records.dtype != np.float64 or records.ndim != 2 or records.shape[1] != RECORD_SIZE:
        raise RecordingError(f"{path}: records of {records.dtype}, shape {records.shape}, must be (n, {RECORD_SIZE})")
    return records


def _write_mcap(path: Path, file: IO[bytes], fingers: Sequence[str], blocks: Iterable[Array]) -> None:
    with McapResults(path, file, fingers) as recording:
        for block in blocks:
            for place, finger in enumerate(fingers):
                recording.append(block[:, place], finger)


def _read_mcap(path: Path, finger: str) -> Array:
    blocks: list[Array] = []
    count = 0
    for part in contents(path):
        if isinstance(part, Ticks) and part.finger == finger:
            try:
                blocks.append(part.records())
            except RecordingError as error:
                raise RecordingError(f"{path}: not results of this version: {error}") from error
            count += len(part.rows)
            _check_count(path, count)
        elif isinstance(part, End) and part.cut and count:
            log.warning("%s is cut short or damaged (%s): %d messages read", path, part.cut, count)
    if not count:
        raise RecordingError(f"{path}: holds no message of topic '{contact_topic(finger)}'")
    return np.concatenate(blocks)


class McapResults(Closing):
    """Records streamed into an MCAP file on topic `contact`, or those of several fingers on a topic each.

    Chunks of 64 KiB go to the system as soon as they are full: after a crash or a kill all but the
    last one can be read. Opening raises RecordingError when the file cannot be made, `append` and
    `close` when it cannot be written (a full disk).
    """

    def __init__(self, path: str | Path, file: IO[bytes] | None = None, fingers: Sequence[str] = ("",)) -> None:
        """`file`: what to write to in place of the path; it is closed in the end."""
        self._path = Path(path)
        with self._told():
            self._recording = RecordingFile(file or open_output(path, 0), fingers, drawn=False)

    def append(self, records: Array, finger: str = "") -> None:
        """Add records (n, RECORD_SIZE) of a finger; a single one may be (RECORD_SIZE,)."""
        with self._told():
            self._recording.ticks(np.atleast_2d(records), finger)

    def close(self) -> None:
        """Write what is left and the index. Any number of times."""
        with self._told():
            self._recording.close()

    @contextmanager
    def _told(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise RecordingError(f"{self._path}: cannot be written: {error.strerror or error}") from error
        except ValueError as error:
            raise RecordingError(str(error)) from error


def _blocks(fingers: Sequence[Array], kind: str) -> Iterator[Array]:
    """Records (n, RECORD_SIZE) of the fingers together, so many rows at a time; a bar on a terminal meanwhile."""
    count = min(map(len, fingers))
    with progress(f"writing {kind}", count) if count >= PROGRESS_MIN_ROWS else nullcontext(lambda number: None) as done:
        for start in range(0, count, BLOCK_ROWS):
            some = [records[start : min(start + BLOCK_ROWS, count)] for records in fingers]
            yield some[0][:, None] if len(some) == 1 else np.stack(some, axis=1)
            done(min(start + BLOCK_ROWS, count))
