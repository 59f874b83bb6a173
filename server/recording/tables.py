"""Poses from numeric tables of other programs; the caller gives meaning and unit of each column."""

from __future__ import annotations

import re
from array import array
from functools import partial
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from softfinger.config.errors import ConfigError, RecordingError
from softfinger.config.files import open_input, write_new_file
from softfinger.drivers.poses import LINE_MAX, POSE_COLUMNS, POSES_MAX, Poses, check_poses
from softfinger.server.progress import show_progress
from softfinger.server.recording.reader import translate_errors
from softfinger.server.recording.results import CSV_CHUNK_ROWS, write_csv_rows

SKIPPED: Final = "-"
"""Name of a column that does not belong to the pose."""
_WIDE: Final = {
    b"\xff\xfe\0\0": "UTF-32", b"\0\0\xfe\xff": "UTF-32", b"\xff\xfe": "UTF-16", b"\xfe\xff": "UTF-16",
}  # fmt: skip
"""Byte order marks of text that is not UTF-8."""
_QUOTED: Final = re.compile(r'"([^"]*)"')
_COMMENT: Final = re.compile(rb"\s*(#|%|//|;|$)")
_NUMBER: Final = re.compile(r"[+-]?([0-9]+[.,]?[0-9]*|[.,][0-9]+)(e[+-]?[0-9]+)?|nan|[+-]?inf", re.IGNORECASE)
_SEPARATORS: Final = {
    ";": re.compile(r"\s*;\s*"),
    "tab": re.compile(r" *\t *"),
    ",": re.compile(r"\s*,\s*"),
    "blank": re.compile(r"\s+"),
    "several": re.compile(r"\s*[,;\s]\s*"),
}
"""Separators of cells. The first that splits the first row into as many cells as there are columns splits all rows."""


class _Dialect:
    """Dialect of a table, from its rows so far.

    separator  name of the separator of cells, empty before the first row
    commas     True for a decimal comma, False for a decimal point, as they occurred
    """

    def __init__(self) -> None:
        self.separator = ""
        self.commas = set[bool]()


class TableFormat(NamedTuple):
    """Format of a table.

    columns  one of POSE_COLUMNS or SKIPPED for each column of the table
    unit_s   s   unit of times
    unit_m   m   unit of positions
    rate_hz  Hz  for a table without times, else None
    skip     lines before the first numbers
    """

    columns: tuple[str, ...]
    unit_s: float = 1.0
    unit_m: float = 1.0
    rate_hz: float | None = None
    skip: int = 0


def make_table_format(columns: str, unit_s: float, unit_m: float, rate_hz: float | None, skip: int) -> TableFormat:
    """Return the format with `columns`, a comma-separated list. Raises ConfigError if it does not describe poses."""
    names = tuple(name.strip() for name in columns.split(","))
    invalid = [name for name in names if name != SKIPPED and (name not in POSE_COLUMNS or names.count(name) > 1)]
    if invalid:
        raise ConfigError(
            f"--columns {columns}: '{invalid[0]}' is not one of {','.join(POSE_COLUMNS)}, each once, or {SKIPPED} for "
            "a column to skip"
        )
    missing = [name for name in "xyz" if name not in names]
    quaternion_names = [name for name in POSE_COLUMNS[4:] if name in names]
    if missing or len(quaternion_names) not in (0, 4):
        raise ConfigError(
            f"--columns {columns}: a pose needs x, y and z, and of qw, qx, qy, qz all or none; without them the "
            "fingertip is not rotated"
        )
    if ("t" in names) == (rate_hz is not None):
        raise ConfigError(f"--columns {columns}: times need either a column t or --rate, not both")
    for option, value in (("--unit-s", unit_s), ("--unit-m", unit_m), ("--rate", rate_hz)):
        if value is not None and not 0.0 < value < np.inf:
            raise ConfigError(f"{option} {value:g}: must be above 0 and finite")
    if skip < 0:
        raise ConfigError(f"--skip {skip}: must be 0 or more lines")
    return TableFormat(names, unit_s, unit_m, rate_hz, skip)


def read_table(path: Path, table_format: TableFormat) -> Poses:
    """Read the poses in a text file of numbers separated by commas, semicolons, tabs or blanks, one row per line.

    Numbers have decimal points, or decimal commas if another character separates them. Empty lines and lines that start
    with #, %, // or ; are skipped. Times are relative to the first row. Raises RecordingError, with the line, if the
    table is malformed.
    """
    numbers, values, dialect = array("q"), array("d"), _Dialect()
    with (
        translate_errors(path, "read"),
        open_input(path) as file,
        show_progress(f"reading {path.name}", path.stat().st_size) as advance,
    ):
        for number, line in enumerate(iter(partial(file.readline, LINE_MAX), b""), 1):
            if not number % CSV_CHUNK_ROWS:
                advance(file.tell())
            if number == 1:
                line = _strip_mark(path, line)
            if number <= table_format.skip or _is_comment(line, len(table_format.columns)):
                continue
            if len(numbers) >= POSES_MAX:
                raise RecordingError(f"{path}: more than {POSES_MAX:,} poses, the limit for reading: split it")
            numbers.append(number)
            values.extend(_parse_row(f"{path}, line {number}", line, table_format, dialect))
    table = np.frombuffer(values).reshape(-1, len(table_format.columns))
    columns_by_name = {name: table[:, at] for at, name in enumerate(table_format.columns)}
    if table_format.rate_hz is None:
        with np.errstate(invalid="ignore", over="ignore"):
            t = table_format.unit_s * (columns_by_name["t"] - columns_by_name["t"][:1])
    else:
        t = np.arange(len(table)) / table_format.rate_hz
    position = table_format.unit_m * np.column_stack([columns_by_name[name] for name in "xyz"])
    orientation = np.tile([1.0, 0.0, 0.0, 0.0], (len(table), 1))
    if "qw" in columns_by_name:
        orientation = np.column_stack([columns_by_name[name] for name in POSE_COLUMNS[4:]])
    return check_poses(
        t, position, orientation, lambda row: f"{path}, line {numbers[row]}" if row < len(numbers) else str(path)
    )


def _strip_mark(path: Path, line: bytes) -> bytes:
    """Return the first line without a byte order mark. Raises RecordingError for text of another kind."""
    if wide := next((name for mark, name in _WIDE.items() if line.startswith(mark)), None):
        raise RecordingError(f"{path}: is text in {wide}: save it as UTF-8")
    if b"\0" in line:
        raise RecordingError(f"{path}: is not text in UTF-8: save it as CSV in UTF-8")
    if b"\r" in line.rstrip(b"\r\n"):
        raise RecordingError(f"{path}, line 1: has carriage returns: save it with line feeds")
    return line.removeprefix(b"\xef\xbb\xbf")


def _is_comment(line: bytes, columns: int) -> bool:
    """Return True for a line without cells: empty, only separators, or a comment."""
    has_cells = line.strip(b" ,;\t\r\n") != b""
    return not has_cells or (_COMMENT.match(line) is not None and line.count(b";") != columns - 1)


def _parse_row(location: str, line: bytes, table_format: TableFormat, dialect: _Dialect) -> list[float]:
    try:
        text = line.decode().replace("\N{MINUS SIGN}", "-")
    except UnicodeDecodeError as error:
        raise RecordingError(f"{location}: not a text file (not UTF-8)") from error
    is_first = dialect.separator == ""
    row = []
    for name, cell in zip(
        table_format.columns, _split_cells(location, text, len(table_format.columns), dialect), strict=True
    ):
        if name != SKIPPED and not _NUMBER.fullmatch(cell):
            fault = "the cell is empty: fill it, or delete the line"
            if cell:
                remedy = "--skip N skips a heading" if is_first else "write a number such as -0.02 or 2e-3"
                fault = f"{cell[:40]!r} is not a number; {remedy}"
            raise RecordingError(f"{location}, column '{name}': {fault}")
        row.append(0.0 if name == SKIPPED else float(cell.replace(",", ".")))
        dialect.commas |= {mark == "," for mark in ",." if name != SKIPPED and mark in cell}
    if len(dialect.commas) > 1:
        raise RecordingError(f"{location}: has decimal commas and decimal points: write all numbers with points")
    return row


def _split_cells(location: str, text: str, columns: int, dialect: _Dialect) -> list[str]:
    """Return the cells of a line, without empty ones at its end that exceed the number of columns.

    A comma between quotation marks is a decimal comma, or in a text that is not read.
    """
    text = _QUOTED.sub(lambda quoted: re.sub("[,;\t]", ".", quoted[1]), text)
    counts = {}
    for name, separator in _SEPARATORS.items():
        if dialect.separator not in ("", name):
            continue
        cells = separator.split(text.strip(" \r\n") if name == "tab" else text.strip())
        while len(cells) > columns and not cells[-1]:
            cells.pop()
        if len(cells) == columns:
            dialect.separator = name
            return cells
        counts[name] = len(cells)
    separator_name, value_count = next(((name, count) for name, count in counts.items() if count > 1), ("", 1))
    advice = f"give a name or {SKIPPED} for each"
    if value_count == 1 and dialect.separator == "":
        advice = "separate them by commas, semicolons, tabs or blanks"
    elif separator_name == "," and value_count > columns and "." not in text:
        advice += "; decimal commas need semicolons, tabs or blanks between the values"
    raise RecordingError(
        f"{location}: {value_count} value{'s' * (value_count != 1)} where --columns has {columns}: {advice}; "
        "--skip N skips lines at the start"
    )


def write_poses(path: Path, poses: Poses) -> None:
    """Write the table for a replay; the file appears complete or not at all."""
    with translate_errors(path), write_new_file(path) as file:
        file.write(",".join(POSE_COLUMNS).encode() + b"\n")
        write_csv_rows(file, np.column_stack(poses))
