"""Export of a recording's ticks for other programs: CSV, Parquet or npz, by the suffix of the file."""

from __future__ import annotations

import importlib.util
import logging
from collections.abc import Callable, Iterator
from functools import partial
from itertools import chain
from pathlib import Path
from typing import IO, Any, Final

import numpy as np

from softfinger.config.errors import ConfigError, RecordingError
from softfinger.config.files import write_new_file
from softfinger.server.recording.contents import read_recording
from softfinger.server.recording.reader import End, TickBlock, explain_no_tick, translate_errors
from softfinger.server.recording.results import RESULTS_MAX, write_csv_rows

log: Final = logging.getLogger(__name__)

SUFFIXES: Final = (".csv", ".parquet", ".npz")
GROUP_ROWS: Final = 65536
"""Ticks of a Parquet row group, which is the unit that readers load: 45 MB."""


def export(recording: str | Path, out: Path, finger: str = "") -> int:
    """Export every tick of a finger and return their number; the file appears only when it is complete.

    Columns are those of the recording, named as in telemetry, with components as `force[0]`. Poses have those of the
    time, the tick, and the probe.

    Parameters
    ----------
    recording
        File, or name of a shipped recording.
    finger
        Name of the finger; empty for a single finger.

    Raises
    ------
    RecordingError
        If the recording cannot be read, has no ticks of this finger, or the output cannot be written.
    ConfigError
        If the suffix is unknown or its library is not installed.
    """
    if out.suffix.lower() not in SUFFIXES:
        raise ConfigError(f"--out {out}: must end in {', '.join(SUFFIXES)}")
    if out.suffix.lower() == ".parquet" and importlib.util.find_spec("pyarrow") is None:
        raise ConfigError(f"--out {out}: pyarrow is not installed: pip install 'softfinger[parquet]'")
    ticks = _read_finger(recording, finger)
    first = next(ticks)
    writers: dict[str, Callable[[IO[bytes], Iterator[TickBlock]], int]] = {
        ".csv": _write_csv,
        ".parquet": _write_parquet,
        ".npz": partial(_write_npz, out),
    }
    write = writers[out.suffix.lower()]
    with translate_errors(out), write_new_file(out) as file:
        return write(file, chain([first], ticks))


def _read_finger(recording: str | Path, finger: str) -> Iterator[TickBlock]:
    other_fingers, has_ticks, end = set[str](), False, End([], "")
    for part in read_recording(recording):
        if isinstance(part, TickBlock) and part.finger == finger:
            has_ticks = True
            yield part
        elif isinstance(part, TickBlock):
            other_fingers.add(part.finger)
        elif isinstance(part, End):
            end = part
    if not (has_ticks or other_fingers):
        raise RecordingError(f"{recording}: {explain_no_tick(end)}")
    if not has_ticks:
        of = f"finger {finger!r}" if finger else "a single finger"
        remedy = f"it has fingers {', '.join(sorted(other_fingers))}: --finger NAME"
        if "" in other_fingers:
            remedy = "leave --finger out"
        raise RecordingError(f"{recording}: no ticks of {of}: {remedy}")
    if end.cut:
        log.warning("%s is incomplete: %s", recording, end.cut)


def list_column_names(ticks: TickBlock) -> list[str]:
    return [f"{p.name}[{i}]" if p.size > 1 else p.name for p in ticks.parts for i in range(p.size)]


def _write_csv(file: IO[bytes], ticks: Iterator[TickBlock]) -> int:
    count = 0
    for part in ticks:
        if not count:
            file.write((",".join(list_column_names(part)) + "\n").encode())
        write_csv_rows(file, part.rows)
        count += len(part.rows)
    return count


def _write_parquet(file: IO[bytes], ticks: Iterator[TickBlock]) -> int:
    import pyarrow
    import pyarrow.parquet

    count, pending = 0, list[Any]()
    writer: Any = None

    def flush() -> None:
        if pending:
            writer.write_table(pyarrow.concat_tables(pending).combine_chunks())
            pending.clear()

    for part in ticks:
        integer_flags = np.repeat([p.is_integer for p in part.parts], [p.size for p in part.parts])
        arrays = [
            pyarrow.array(column.astype(np.int64) if is_integer else column)
            for column, is_integer in zip(part.rows.T, integer_flags, strict=True)
        ]
        table = pyarrow.table(arrays, names=list_column_names(part))
        writer = writer or pyarrow.parquet.ParquetWriter(file, table.schema)
        pending.append(table)
        count += len(part.rows)
        if sum(map(len, pending)) >= GROUP_ROWS:
            flush()
    flush()
    if writer is not None:
        writer.close()
    return count


def _write_npz(out: Path, file: IO[bytes], ticks: Iterator[TickBlock]) -> int:
    """Write one array per field, like results; all ticks are in memory, so their number is limited."""
    parts: list[TickBlock] = []
    count = 0
    for part in ticks:
        parts.append(part)
        count += len(part.rows)
        if count > RESULTS_MAX:
            raise RecordingError(f"--out {out}: more than {RESULTS_MAX:,} ticks, the limit of an npz: use .parquet")
    rows = TickBlock(parts[0].finger, parts[0].parts, np.concatenate([part.rows for part in parts]))
    arrays: dict[str, Any] = {part.name: rows.column(part.name) for part in rows.parts}
    if not rows.missing():
        arrays["records"] = rows.records()
    np.savez(file, **arrays)
    return count
