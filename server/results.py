"""Results: one record a tick, written to and read from .csv, .npz and .mcap without losing a bit.

All three follow from the record table: CSV has a column per component, npz an array per field, and
MCAP a protobuf message whose dotted names become nested messages. The message type is built at run
time and travels inside the file, so any MCAP reader can decode it.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from functools import cache
from itertools import repeat
from pathlib import Path
from types import TracebackType
from typing import IO, Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import RecordingError
from softfinger.drivers.poses import TOPIC, decoded_messages
from softfinger.proxy.state import FIELDS, OFFSET, RECORD_SIZE, columns

Array = NDArray[np.float64]

ENDINGS: Final = (".csv", ".npz", ".mcap")
MESSAGE_NAME: Final = "softfinger.Tick"
CHUNK_BYTES: Final = 64 * 1024
BLOCK_ROWS: Final = 2_000
PROGRESS_MIN_ROWS: Final = 50_000  # about a second of writing; below, a bar would only flash


def write_results(path: str | Path, records: Array) -> None:
    """Write records (n, RECORD_SIZE) in the format named by the ending; RecordingError when it cannot be done.

    The file appears whole or not at all. Long writes show their progress when stderr is a terminal.
    """
    target = Path(path)
    writer = {".csv": _write_csv, ".npz": _write_npz, ".mcap": _write_mcap}.get(target.suffix.lower())
    if writer is None:
        raise RecordingError(_unknown_ending(target))
    records = np.ascontiguousarray(records, dtype=np.float64)
    if records.ndim != 2 or records.shape[1] != RECORD_SIZE:
        raise RecordingError(f"{target}: records of shape {records.shape}, must be (n, {RECORD_SIZE})")
    target = target.resolve()  # a link keeps pointing at what is replaced
    part = target.with_name(f".{target.name}.part")
    try:
        try:
            writer(part, records)
            os.replace(part, target)
        finally:
            part.unlink(missing_ok=True)
    except OSError as error:
        raise RecordingError(f"{target}: cannot be written: {error.strerror or error}") from error


def read_results(path: str | Path) -> Array:
    """Read records (n, RECORD_SIZE) as `write_results` wrote them; RecordingError when they cannot be read."""
    source = Path(path)
    reader = {".csv": _read_csv, ".npz": _read_npz, ".mcap": _read_mcap}.get(source.suffix.lower())
    if reader is None:
        raise RecordingError(_unknown_ending(source))
    try:
        return reader(source)
    except OSError as error:
        raise RecordingError(f"{source}: cannot be read: {error.strerror or error}") from error


def _unknown_ending(path: Path) -> str:
    seen = f"'{path.suffix}'" if path.suffix else "no ending"
    return f"{path}: {seen} names no results format: use one of {', '.join(ENDINGS)}"


def _write_csv(path: Path, records: Array) -> None:
    line = ",".join(repeat("%.17g", RECORD_SIZE)) + "\n"  # 17 digits bring every float64 back
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(",".join(columns()) + "\n")
        for block in _blocks(records, "csv"):
            file.write("".join([line % tuple(row) for row in block.tolist()]))


def _read_csv(path: Path) -> Array:
    try:
        with path.open(encoding="ascii") as file:
            header = file.readline().rstrip("\n").split(",")
            if header != columns():
                raise RecordingError(f"{path}, line 1: not the columns of this version's results")
            rows = [[float(cell) for cell in line.split(",")] for line in file]
        return np.array(rows, dtype=np.float64).reshape(len(rows), RECORD_SIZE)
    except ValueError as error:
        raise RecordingError(f"{path}: not a results file: {error}") from error


def _write_npz(path: Path, records: Array) -> None:
    arrays: dict[str, Any] = {f.name: records[:, OFFSET[f.name] : OFFSET[f.name] + f.size] for f in FIELDS}
    arrays = {name: array[:, 0] if array.shape[1] == 1 else array for name, array in arrays.items()}
    with path.open("wb") as file:
        np.savez(file, records=records, **arrays)


def _read_npz(path: Path) -> Array:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            records = np.asarray(archive["records"])
    except OSError:
        raise
    except Exception as error:  # zip and npy decoders fail in many ways on damaged bytes
        raise RecordingError(f"{path}: not a results file: {type(error).__name__}: {error}") from error
    if records.dtype != np.float64 or records.ndim != 2 or records.shape[1] != RECORD_SIZE:
        raise RecordingError(f"{path}: records of {records.dtype}, shape {records.shape}, must be (n, {RECORD_SIZE})")
    return records


def _write_mcap(path: Path, records: Array) -> None:
    with McapResults(path) as recording:
        for block in _blocks(records, "mcap"):
            recording.append(block)


def _read_mcap(path: Path) -> Array:
    ways = [(f, f.name.split(".")) for f in FIELDS]
    rows = []
    try:
        for message in decoded_messages(path):
            row: list[float] = []
            for field, way in ways:
                value = message
                for name in way:
                    value = getattr(value, name)
                row.extend(value if field.size > 1 else (value,))
            rows.append(row)
        return np.array(rows, dtype=np.float64).reshape(len(rows), RECORD_SIZE)
    except (AttributeError, TypeError, ValueError) as error:
        raise RecordingError(f"{path}: not results of this version: {error}") from error


class McapResults:
    """Records streamed into an MCAP file on topic `contact`.

    Chunks of 64 KiB go to the system as soon as they are full: after a crash or a kill all but the
    last one can be read. Opening raises RecordingError when the file cannot be made, `append` and
    `close` when it cannot be written (a full disk).
    """

    def __init__(self, path: str | Path) -> None:
        from mcap.writer import Writer

        self._path = Path(path)
        self._layout = _Layout()
        try:
            self._file: IO[bytes] = self._path.open("wb")
        except OSError as error:
            raise RecordingError(f"{self._path}: cannot be written: {error.strerror or error}") from error
        self._writer: Any = Writer(self._file, chunk_size=CHUNK_BYTES)
        self._writer.start(profile="", library="softfinger")
        schema = self._writer.register_schema(MESSAGE_NAME, "protobuf", descriptor_set())
        self._channel = self._writer.register_channel(TOPIC, "protobuf", schema)

    def append(self, records: Array) -> None:
        """Add records (n, RECORD_SIZE); a single one may be (RECORD_SIZE,)."""
        rows = np.atleast_2d(records)
        messages = self._layout.encode(rows)
        seconds = np.nan_to_num(rows[:, OFFSET["timestamp"]], nan=0.0, posinf=0.0, neginf=0.0)
        times = np.rint(np.clip(seconds, 0.0, 9e9) * 1e9).astype(np.int64).tolist()  # MCAP has no time before 1970
        ticks = rows[:, OFFSET["tick"]].astype(np.int64).tolist()
        try:
            for time_ns, tick, message in zip(times, ticks, messages, strict=True):
                self._writer.add_message(self._channel, time_ns, message, time_ns, sequence=tick & 0xFFFFFFFF)
            self._file.flush()
        except OSError as error:
            raise RecordingError(f"{self._path}: cannot be written: {error.strerror or error}") from error

    def close(self) -> None:
        """Write what is left and the index. Any number of times."""
        if self._file.closed:
            return
        try:
            with self._file:
                self._writer.finish()
        except OSError as error:
            raise RecordingError(f"{self._path}: cannot be written: {error.strerror or error}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@cache
def descriptor_set() -> bytes:
    """The message type as a serialized FileDescriptorSet, built from the record table.

    Dotted names become nested messages. Integers are sfixed64, so that every message has the same
    length and layout.
    """
    from google.protobuf import descriptor_pb2

    kinds = descriptor_pb2.FieldDescriptorProto
    files = descriptor_pb2.FileDescriptorSet()
    package, _, name = MESSAGE_NAME.rpartition(".")
    file = files.file.add(name="softfinger/tick.proto", package=package, syntax="proto3")
    top = file.message_type.add(name=name)
    nested: dict[str, Any] = {}
    for field in FIELDS:
        message, within = top, f".{MESSAGE_NAME}"
        *parents, leaf = field.name.split(".")
        for depth, parent in enumerate(parents):
            type_name, key = parent.capitalize(), ".".join(parents[: depth + 1])
            within = f"{within}.{type_name}"
            if key not in nested:
                nested[key] = message.nested_type.add(name=type_name)
                message.field.add(
                    name=parent,
                    number=len(message.field) + 1,
                    type=kinds.TYPE_MESSAGE,
                    type_name=within,
                    label=kinds.LABEL_OPTIONAL,
                )
            message = nested[key]
        message.field.add(
            name=leaf,
            number=len(message.field) + 1,
            type=kinds.TYPE_SFIXED64 if field.kind == "int" else kinds.TYPE_DOUBLE,
            label=kinds.LABEL_REPEATED if field.size > 1 else kinds.LABEL_OPTIONAL,
        )
    return bytes(files.SerializeToString(deterministic=True))


class _Layout:
    """Where each column stands in an encoded message.

    All numbers have eight bytes, so every message is the same template with other numbers in it.
    The template is made by the protobuf library from marker values, then filled for a whole block
    at once.
    """

    def __init__(self) -> None:
        from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

        pool = descriptor_pool.DescriptorPool()
        for file in descriptor_pb2.FileDescriptorSet.FromString(descriptor_set()).file:
            pool.Add(file)
        message = message_factory.GetMessageClass(pool.FindMessageTypeByName(MESSAGE_NAME))()
        for field in FIELDS:
            *parents, leaf = field.name.split(".")
            owner = message
            for parent in parents:
                owner = getattr(owner, parent)
            markers = [_marker(OFFSET[field.name] + i) for i in range(field.size)]
            if field.size > 1:
                getattr(owner, leaf).extend(markers)
            else:
                setattr(owner, leaf, markers[0] if field.kind == "float" else int(markers[0]))
        encoded = message.SerializeToString(deterministic=True)
        self._template = np.frombuffer(encoded, dtype=np.uint8)
        self._integer = np.repeat([f.kind == "int" for f in FIELDS], [f.size for f in FIELDS])
        self._at = np.array([self._find(encoded, column) for column in range(RECORD_SIZE)])

    def _find(self, encoded: bytes, column: int) -> int:
        marker = np.array(_marker(column), dtype="<i8" if self._integer[column] else "<f8").tobytes()
        return encoded.index(marker)

    def encode(self, rows: Array) -> list[bytes]:
        """Encoded messages of records (n, RECORD_SIZE)."""
        values = np.array(rows, dtype="<f8")
        counts = values[:, self._integer]
        with np.errstate(invalid="ignore"):
            whole = counts.astype("<i8")
        if not np.array_equal(whole, counts):
            row, column = (int(i) for i in np.argwhere(whole != counts)[0])
            name = columns()[int(np.flatnonzero(self._integer)[column])]
            raise RecordingError(f"record {row}: {name} = {counts[row, column]}, must be a whole number")
        values[:, self._integer] = whole.view("<f8")  # the bit pattern of the integer
        messages = np.tile(self._template, (len(values), 1))
        messages[:, self._at[:, None] + np.arange(8)] = values.view(np.uint8).reshape(len(values), RECORD_SIZE, 8)
        return [message.tobytes() for message in messages]


def _marker(column: int) -> float:
    """A number found nowhere else in an encoded message, exact as float64 and as integer."""
    return float(0x5AA5_3CC3_0000 + 0x0101 * (column + 1))


def _blocks(records: Array, kind: str) -> Iterator[Array]:
    """Slices of the records; while they are worked on, a bar on a terminal."""
    starts = range(0, len(records), BLOCK_ROWS)
    if len(records) < PROGRESS_MIN_ROWS or not sys.stderr.isatty():
        for start in starts:
            yield records[start : start + BLOCK_ROWS]
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(f"writing {kind}", total=len(records))
        for start in starts:
            block = records[start : start + BLOCK_ROWS]
            yield block
            progress.advance(task, len(block))
