"""Results files: one record per tick, written to and read from .csv, .npz and .mcap without loss of a bit.

All formats follow the record table: CSV has a column per component, npz an array per field, and MCAP a protobuf message
whose dotted names become nested messages. The message type is built at run time and stored in the file, so any MCAP
reader can decode it.

With several fingers, names of columns and arrays have the finger's name as prefix, as in `thumb.force[0]`, and MCAP has
a topic for each, `finger/thumb`.
"""

from __future__ import annotations

import logging
import math
import os
from array import array
from collections import deque
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import groupby, repeat
from pathlib import Path
from typing import IO, Any, Final, NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from softfinger.config.arrays import Array
from softfinger.config.arrays.grids import open_npz
from softfinger.config.errors import RecordingError
from softfinger.config.files import open_input, write_new_file
from softfinger.drivers.poses import LINE_MAX
from softfinger.proxy.record import RECORD_SIZE, list_columns
from softfinger.server.progress import show_progress
from softfinger.server.recording.npz_results import make_prefix, write_npz
from softfinger.server.recording.reader import End, TickBlock, read_contents, translate_errors
from softfinger.server.recording.writer import RecordingFile
from softfinger.server.wire.protocol import name_contact_topic

SUFFIXES: Final = (".csv", ".npz", ".mcap")
RESULTS_MAX: Final = 2_000_000
"""Limit of records read: 33 minutes at 1 kHz, 3 GB."""
CSV_CHUNK_ROWS: Final = 500
"""Rows formatted at a time, which fit into the processor's cache; also rows per progress report."""
MAX_PLAIN_INTEGER: Final = 1e16
"""Integers from here on are written with an exponent."""

_JSON: Final = msgspec.json.Encoder()
_MINUS_ZERO: Final = msgspec.Raw(b"-0")

log: Final = logging.getLogger(__name__)


class RunContext(NamedTuple):
    """Contents of a simulated run that only MCAP stores, in addition to the records.

    about     tables of metadata (`RecordingFile`); if its scene has a [world], the topics for viewers are written too
    messages  topics and messages of the blocks so far, maps as on the wire; the writer removes them
    """

    about: Mapping[str, Any]
    messages: deque[tuple[str, dict[str, Any]]]


def write_blocks(
    path: str | Path, fingers: Sequence[str], blocks: Iterable[Array], context: RunContext | None = None
) -> None:
    """Write records in the format of the file ending: .csv, .npz or .mcap.

    The file appears complete or not at all. An exception of `blocks` is propagated.

    path     file to write or replace
    fingers  names of several fingers, an empty name for a single one
    blocks   records (m, fingers, RECORD_SIZE), of which only one block is in memory at a time

    Raises RecordingError if the file cannot be written.
    """
    target = Path(path)
    write_mcap = partial(_write_mcap, context=context or RunContext({}, deque()))
    writers: dict[str, Callable[..., None]] = {".csv": _write_csv, ".npz": write_npz, ".mcap": write_mcap}
    writer = writers.get(target.suffix.lower())
    if writer is None:
        raise RecordingError(_make_suffix_error(target))
    with translate_errors(target), write_new_file(target) as file:
        writer(target, file, fingers, blocks)


def read_results(path: str | Path, finger: str = "") -> Array:
    """Read the records of a file from `write_blocks`.

    Parameters
    ----------
    path
        File with the ending .csv, .npz or .mcap.
    finger
        Name of the finger to read; empty for a file of a single finger.

    Returns
    -------
    Array
        Records (n, RECORD_SIZE), equal bit for bit to the written ones.

    Raises
    ------
    RecordingError
        If the file cannot be read, or has more than RESULTS_MAX records.
    """
    source = Path(path)
    reader = {".csv": _read_csv, ".npz": _read_npz, ".mcap": _read_mcap}.get(source.suffix.lower())
    if reader is None:
        raise RecordingError(_make_suffix_error(source))
    with translate_errors(source, "read"):
        return reader(source, finger)


def list_fingers(path: Path) -> list[str]:
    """Return the names of several fingers in a .csv or .npz from `write_blocks`; empty for any other file.

    Raises RecordingError if the file cannot be read.
    """
    first, others = list_columns()[0], (list_columns()[-1], "records")  # of a .csv, of an .npz
    with translate_errors(path, "read"), open_input(path) as file:
        if path.suffix.lower() == ".csv":
            names = file.readline(LINE_MAX).decode("ascii", "replace").rstrip("\n").split(",")
        else:
            try:
                names = list(open_npz(file).files)
            except OSError:
                raise
            except Exception:  # not an archive: its reader reports that
                return []
    fingers = [name.removesuffix(f".{first}") for name in names if name.endswith(f".{first}")]
    return [finger for finger in fingers if any(f"{finger}.{other}" in names for other in others)]


class NoResults(RecordingError):
    """The file is not a table of results of this version; it may be one of poses."""


def _check_count(path: Path, count: int) -> None:
    if count > RESULTS_MAX:
        raise RecordingError(f"{path}: more than {RESULTS_MAX:,} records, the limit for reading")


def _make_suffix_error(path: Path) -> str:
    reason = f"'{path.suffix}' is no format of results" if path.suffix else "has no suffix"
    return f"{path}: {reason}: use one of {', '.join(SUFFIXES)}"


def _write_csv(path: Path, file: IO[bytes], fingers: Sequence[str], blocks: Iterable[Array]) -> None:
    file.write((",".join(make_prefix(name) + column for name in fingers for column in list_columns()) + "\n").encode())
    for block in blocks:
        write_csv_rows(file, block.reshape(len(block), -1))


def write_csv_rows(file: IO[bytes], rows: Array) -> None:
    """Write rows (n, width) as lines of CSV, which restore every float64 exactly; report the progress."""
    with show_progress("writing csv", len(rows)) as advance:
        for at in range(0, len(rows), CSV_CHUNK_ROWS):
            file.write(_format_chunk(rows[at : at + CSV_CHUNK_ROWS]))
            advance(at)


def _format_chunk(rows: Array) -> bytes:
    """Format rows with the JSON encoder: the shortest exact digits, several times as fast as in Python."""
    if not np.isfinite(rows).all():
        line = ",".join(repeat("%.17g", rows.shape[1])) + "\n"  # 17 digits restore every float64
        return "".join([line % tuple(row) for row in rows.tolist()]).encode()
    by_column = np.array(rows.T, order="C")
    bits = by_column.view(np.int64)
    is_constant = (bits == bits[:, :1]).all(axis=1)
    # JSON writes an integral float with `.0` unless it is an int, and no int is -0.
    is_integral = (np.rint(by_column) == by_column) & (np.abs(by_column) < MAX_PLAIN_INTEGER)
    has_integral = is_integral.any(axis=1).tolist()
    columns: list[Iterable[Any]] = []
    for is_constant_group, group in groupby(range(len(by_column)), is_constant.tolist().__getitem__):
        if is_constant_group:  # values that are constant over the rows are formatted once
            text = _JSON.encode(by_column[list(group), 0].tolist())[1:-1] + b","
            columns.append(repeat(msgspec.Raw(text.replace(b".0,", b",")[:-1]), len(rows)))
        else:
            columns.extend(
                _with_integers(by_column[at], is_integral[at]) if has_integral[at] else by_column[at].tolist()
                for at in group
            )
    return _JSON.encode_lines(list(zip(*columns, strict=True))).translate(None, b"[]")


def _with_integers(column: Array, is_integral: NDArray[np.bool_]) -> list[Any]:
    """Return the numbers of a column (n,), with integral ones as int, which JSON writes without `.0`."""
    numbers: list[Any] = column.tolist()
    for row in is_integral.nonzero()[0].tolist():
        numbers[row] = int(numbers[row]) or (_MINUS_ZERO if math.copysign(1.0, numbers[row]) < 0.0 else 0)
    return numbers


def _read_csv(path: Path, finger: str) -> Array:
    values = array("d")
    try:
        with open_input(path) as file:
            header = file.readline(LINE_MAX).decode("ascii", "replace").rstrip("\n").split(",")
            expected = [make_prefix(finger) + column for column in list_columns()]
            first = header.index(expected[0]) if expected[0] in header else 0
            if header[first : first + RECORD_SIZE] != expected or len(header) % RECORD_SIZE:
                of_finger = f" of a finger '{finger}'" if finger else ""
                raise NoResults(f"{path}, line 1: the columns differ from those of this version{of_finger}")
            with show_progress(f"reading {path.name}", os.fstat(file.fileno()).st_size) as advance:
                while line := file.readline(LINE_MAX):
                    if not len(values) % (CSV_CHUNK_ROWS * RECORD_SIZE):
                        advance(file.tell())
                    cells = line.split(b",")
                    if len(cells) != len(header):
                        raise ValueError(f"a line of {len(cells)} numbers, must be {len(header)}")
                    values.extend(map(float, cells[first : first + RECORD_SIZE]))
                    _check_count(path, len(values) // RECORD_SIZE)
        return np.array(values, dtype=np.float64).reshape(-1, RECORD_SIZE)
    except ValueError as error:
        raise RecordingError(f"{path}, line {len(values) // RECORD_SIZE + 2}: {error}") from error


def _read_npz(path: Path, finger: str) -> Array:
    try:
        with open_input(path) as file:
            records = open_npz(file)[make_prefix(finger) + "records"]
    except OSError:
        raise
    except KeyError as error:
        raise NoResults(f"{path}: has no array {error.args[0]}") from error
    except Exception as error:  # zip and npy decoders raise many types of errors on damaged bytes
        raise RecordingError(f"{path}: not a results file: {type(error).__name__}: {error}") from error
    _check_count(path, len(records) if records.ndim else 0)
    if records.dtype != np.float64 or records.ndim != 2 or records.shape[1] != RECORD_SIZE:
        raise NoResults(f"{path}: records of {records.dtype}, shape {records.shape}, must be (n, {RECORD_SIZE})")
    return records


def _write_mcap(
    path: Path, file: IO[bytes], fingers: Sequence[str], blocks: Iterable[Array], context: RunContext
) -> None:
    has_world = context.about.get("scene", {}).get("world") is not None
    recording = RecordingFile(file, fingers, context.about, with_pictures=has_world)
    try:
        for block in blocks:
            for index, finger in enumerate(fingers):
                try:
                    recording.ticks(block[:, index], finger)
                except ValueError as error:
                    raise RecordingError(str(error)) from error
            while context.messages:
                recording.message(*context.messages.popleft())
    finally:
        recording.close()


def _read_mcap(path: Path, finger: str) -> Array:
    blocks: list[Array] = []
    count = 0
    for part in read_contents(path):
        if isinstance(part, TickBlock) and part.finger == finger:
            try:
                blocks.append(part.records())
            except RecordingError as error:
                raise RecordingError(f"{path}: not results of this version: {error}") from error
            count += len(part.rows)
            _check_count(path, count)
        elif isinstance(part, End) and part.cut and count:
            log.warning("%s is truncated or damaged (%s): %d messages read", path, part.cut, count)
    if not count:
        raise RecordingError(f"{path}: has no message on topic '{name_contact_topic(finger)}'")
    return np.concatenate(blocks)
