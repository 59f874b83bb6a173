"""Poses from numeric tables of other programs; the caller gives meaning and unit of each column."""

from __future__ import annotations

import re
from array import array
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from softfinger.config.errors import ConfigError, RecordingError
from softfinger.config.files import new_file, open_input
from softfinger.drivers.poses import LINE_MAX, POSE_COLUMNS, POSES_MAX, Poses, check_poses
from softfinger.server.offline.results import csv_lines

SKIPPED: Final = "-"
"""Name of a column that does not belong to the pose."""
_REMARK: Final = re.compile(rb"\s*(#|%|//|;|$)")
_BETWEEN: Final = re.compile(r"\s*[,;\s]\s*")


class Layout(NamedTuple):
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


def layout_of(columns: str, unit_s: float, unit_m: float, rate_hz: float | None, skip: int) -> Layout:
    """Return a Layout; `columns` is a comma-separated list. Raises ConfigError if it does not describe poses."""
    names = tuple(name.strip() for name in columns.split(","))
    odd = [name for name in names if name != SKIPPED and (name not in POSE_COLUMNS or names.count(name) > 1)]
    if odd:
        raise ConfigError(
            f"--columns {columns}: '{odd[0]}' is not one of {','.join(POSE_COLUMNS)}, each once, or {SKIPPED} for a "
            "column that is left out"
        )
    missing = [name for name in "xyz" if name not in names]
    turned = [name for name in POSE_COLUMNS[4:] if name in names]
    if missing or len(turned) not in (0, 4):
        raise ConfigError(
            f"--columns {columns}: a pose needs x, y and z, and of qw, qx, qy, qz all or none; without them the "
            "fingertip is not turned"
        )
    if ("t" in names) == (rate_hz is not None):
        raise ConfigError(f"--columns {columns}: times come from a column t or from --rate, one of the two")
    for option, value in (("--unit-s", unit_s), ("--unit-m", unit_m), ("--rate", rate_hz)):
        if value is not None and not 0.0 < value < np.inf:
            raise ConfigError(f"{option} {value:g}: must be above 0")
    if skip < 0:
        raise ConfigError(f"--skip {skip}: must be 0 or more lines")
    return Layout(names, unit_s, unit_m, rate_hz, skip)


def read_table(path: Path, layout: Layout) -> Poses:
    """Read the poses in a text file of numbers separated by commas, semicolons, tabs or blanks, one row per line.

    Empty lines and lines that start with #, %, // or ; are skipped. Times are relative to the first row. Raises
    RecordingError, with the line, if the table is malformed.
    """
    numbers, values = array("q"), array("d")
    try:
        with open_input(path) as file:
            number = 0
            while line := file.readline(LINE_MAX):
                number += 1
                if number <= layout.skip or _REMARK.match(line):
                    continue
                if len(numbers) >= POSES_MAX:
                    raise RecordingError(f"{path}: more than {POSES_MAX:,} poses, the most that are read: cut it up")
                numbers.append(number)
                values.extend(_row(f"{path}, line {number}", line, layout.columns))
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    table = np.frombuffer(values).reshape(-1, len(layout.columns))
    wanted = {name: table[:, at] for at, name in enumerate(layout.columns)}
    if layout.rate_hz is None:
        t = layout.unit_s * (wanted["t"] - wanted["t"][:1])
    else:
        t = np.arange(len(table)) / layout.rate_hz
    position = layout.unit_m * np.column_stack([wanted[name] for name in "xyz"])
    orientation = np.tile([1.0, 0.0, 0.0, 0.0], (len(table), 1))
    if "qw" in wanted:
        orientation = np.column_stack([wanted[name] for name in POSE_COLUMNS[4:]])
    return check_poses(
        t, position, orientation, lambda row: f"{path}, line {numbers[row]}" if row < len(numbers) else str(path)
    )


def _row(place: str, line: bytes, columns: Sequence[str]) -> list[float]:
    try:
        cells = _BETWEEN.split(line.decode().strip().rstrip(",;"))
    except UnicodeDecodeError as error:
        raise RecordingError(f"{place}: not a text file (not UTF-8)") from error
    if len(cells) != len(columns):
        raise RecordingError(
            f"{place}: {len(cells)} values where --columns has {len(columns)}: give a name or {SKIPPED} for each; "
            "--skip leaves lines out at the beginning"
        )
    row = []
    for name, cell in zip(columns, cells, strict=True):
        try:
            row.append(0.0 if name == SKIPPED else float(cell))
        except ValueError as error:
            raise RecordingError(f"{place}, column '{name}': {cell[:40]!r} is not a number") from error
    return row


def write_poses(path: Path, poses: Poses) -> None:
    """Write the table for a replay; the file appears complete or not at all."""
    with new_file(path) as file:
        file.write(",".join(POSE_COLUMNS).encode() + b"\n")
        file.write(csv_lines(np.column_stack(poses)))
