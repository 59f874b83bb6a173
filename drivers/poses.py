"""Recorded poses: read from CSV, from this program's results (CSV, npz, MCAP), and checked.

A recording is foreign input. Whatever its bytes are, reading it gives poses or a RecordingError
that says where the fault is; nothing in it is ever unpickled.
"""

from __future__ import annotations

import difflib
import logging
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import RecordingError

Array = NDArray[np.float64]

SHIPPED: Final = Path(__file__).resolve().parents[1] / "config" / "recordings"
"""Where the recordings that come with the program stand."""
POSE_COLUMNS: Final = ("t", "x", "y", "z", "qw", "qx", "qy", "qz")
RESULT_COLUMNS: Final = (
    "timestamp",
    *(f"probe.position[{i}]" for i in range(3)),
    *(f"probe.orientation[{i}]" for i in range(4)),
)
TOPIC: Final = "contact"
ENDINGS: Final = (".csv", ".npz", ".mcap")

POSITION_MAX_M: Final = 1e6
STEP_MIN_S: Final = 1e-9  # below it a velocity between two rows says nothing
NORM_MIN, NORM_MAX = 0.5, 2.0  # a quaternion outside was never meant to be a unit one
NORM_ROUNDING: Final = 1e-15  # a quaternion this close to a unit one was normalised before, and is kept to the bit

log: Final = logging.getLogger(__name__)


class Poses(NamedTuple):
    """A recorded motion: t (N,) s, strictly increasing; position (N, 3) m; orientation (N, 4) unit
    quaternions w, x, y, z, fingertip to world, neighbours on the same half of the sphere."""

    t: Array
    position: Array
    orientation: Array


def load_poses(recording: str | Path) -> Poses:
    """Read a file, or a shipped recording by its name; RecordingError when it cannot be used.

    The file's ending says what it is: .csv (`t,x,y,z,qw,qx,qy,qz` in s, m and unit quaternions, in
    any column order, or a results file), .npz (results) or .mcap (a recording of this program; a
    truncated one is read as far as it goes, with a warning in the log). Times of results count
    from their first row.
    """
    path = find_recording(recording)
    readers = {".csv": _read_csv, ".npz": _read_npz, ".mcap": _read_mcap}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise RecordingError(
            f"{path}: cannot tell what kind of recording this is: give it one of the endings {', '.join(ENDINGS)}"
        )
    try:
        return reader(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    except MemoryError as error:
        raise RecordingError(f"{path}: does not fit in memory, or its header is damaged") from error


def shipped_names() -> list[str]:
    """Names of the recordings that come with the program."""
    return sorted(path.stem for path in SHIPPED.glob("*.csv"))


def find_recording(recording: str | Path) -> Path:
    """The file meant by a path or by a shipped name (with or without .csv)."""
    try:
        path = Path(recording)
        if path.exists():
            return path
    except (ValueError, OSError) as error:  # too long, or a NUL in it
        raise RecordingError(f"recording {str(recording)[:80]!r} is not a usable file name: {error}") from error
    names = shipped_names()
    name = str(recording).removesuffix(".csv")
    if name in names:
        return SHIPPED / f"{name}.csv"
    close = difflib.get_close_matches(name, names, n=1)
    hint = f"did you mean '{close[0]}'? " if close else ""
    raise RecordingError(
        f"recording '{recording}' is neither a file nor a shipped recording: {hint}Shipped are {', '.join(names)}"
    )


def checked(t: Array, position: Array, orientation: Array, place: Callable[[int], str]) -> Poses:
    """Poses from raw columns (N,), (N, 3), (N, 4): finite, in order, quaternions normalised and continuous in sign.

    `place(row)` says where a row stands, for the RecordingError.
    """
    if len(t) < 2:
        raise RecordingError(f"{place(0)}: {len(t)} pose(s), at least 2 are needed")
    values = np.column_stack((t, position, orientation))
    finite = np.isfinite(values)
    if not finite.all():
        row, column = (int(i) for i in np.argwhere(~finite)[0])
        raise RecordingError(
            f"{place(row)}, column '{POSE_COLUMNS[column]}': {values[row, column]} is not a finite number"
        )
    far = np.abs(position) > POSITION_MAX_M
    if far.any():
        row, column = (int(i) for i in np.argwhere(far)[0])
        raise RecordingError(
            f"{place(row)}, column '{'xyz'[column]}': {position[row, column]:g} m is outside "
            f"{-POSITION_MAX_M:g} to {POSITION_MAX_M:g} m: positions are in metres"
        )
    with np.errstate(over="ignore"):  # an infinite norm or step is refused below
        step = np.diff(t)
        norm = np.sqrt(np.sum(orientation**2, axis=1))
    late = step < STEP_MIN_S
    if late.any():
        row = int(np.argmax(late)) + 1
        raise RecordingError(
            f"{place(row)}, column 't': {t[row]:.9g} s does not follow {t[row - 1]:.9g} s: times must increase"
        )
    odd = ~((norm >= NORM_MIN) & (norm <= NORM_MAX))
    if odd.any():
        row = int(np.argmax(odd))
        raise RecordingError(
            f"{place(row)}, columns 'qw' to 'qz': quaternion of norm {norm[row]:.6g}, "
            f"must be 1 (accepted and normalised: {NORM_MIN:g} to {NORM_MAX:g})"
        )
    unit = orientation / np.where(np.abs(norm - 1.0) < NORM_ROUNDING, 1.0, norm)[:, None]
    flip = np.sum(unit[1:] * unit[:-1], axis=1) < 0.0
    sign = np.concatenate(([1.0], np.cumprod(np.where(flip, -1.0, 1.0))))
    return Poses(np.array(t), np.array(position), unit * sign[:, None])


def _read_csv(path: Path) -> Poses:
    try:
        lines = path.read_bytes().decode("utf-8-sig").splitlines()
    except UnicodeDecodeError as error:
        raise RecordingError(f"{path}: not a text file (byte {error.start} is not UTF-8)") from error
    names = [name.strip() for name in lines[0].split(",")] if lines else []
    wanted = RESULT_COLUMNS if set(RESULT_COLUMNS) <= set(names) else POSE_COLUMNS
    missing = [name for name in wanted if names.count(name) != 1]
    if missing:
        raise RecordingError(
            f"{path}, line 1: column(s) {', '.join(missing)} missing or given twice: "
            f"the header must name {','.join(POSE_COLUMNS)} (other columns are ignored)"
        )
    numbers = [number for number, line in enumerate(lines[1:], start=2) if line.strip()]
    index = [names.index(name) for name in wanted]
    table = np.empty((len(numbers), len(wanted)))
    for row, number in enumerate(numbers):
        cells = lines[number - 1].split(",")
        if len(cells) != len(names):
            raise RecordingError(f"{path}, line {number}: {len(cells)} values, the header names {len(names)}")
        for k, column in enumerate(index):
            try:
                table[row, k] = float(cells[column])
            except ValueError as error:
                raise RecordingError(
                    f"{path}, line {number}, column '{wanted[k]}': {cells[column][:40]!r} is not a number"
                ) from error
    place = _place(path, numbers)
    return checked(_from_first(table[:, 0], wanted is RESULT_COLUMNS), table[:, 1:4], table[:, 4:8], place)


def _read_npz(path: Path) -> Poses:
    columns = []
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            for name, shape in (("timestamp", ()), ("probe.position", (3,)), ("probe.orientation", (4,))):
                array = np.asarray(archive[name])
                if array.dtype.kind not in "fiu" or array.shape[1:] != shape or array.ndim != 1 + len(shape):
                    raise RecordingError(
                        f"{path}, array '{name}': {array.dtype} of shape {array.shape}, "
                        f"must be numbers of shape {('N', *shape)}"
                    )
                columns.append(array.astype(np.float64))
    except (RecordingError, OSError, MemoryError):
        raise
    except Exception as error:  # zip and npy decoders fail in many ways on damaged bytes
        raise RecordingError(
            f"{path}: not a readable results file: {_reason(error)}: it must be an .npz with timestamp, "
            "probe.position and probe.orientation"
        ) from error
    t, position, orientation = columns
    if not len(t) == len(position) == len(orientation):
        raise RecordingError(f"{path}: arrays of {len(t)}, {len(position)} and {len(orientation)} rows, must be equal")
    return checked(_from_first(t, True), position, orientation, _place(path))


def _read_mcap(path: Path) -> Poses:
    rows = []
    for number, message in enumerate(decoded_messages(path)):
        try:
            rows.append((message.timestamp, *message.probe.position, *message.probe.orientation))
        except (AttributeError, TypeError) as error:
            raise RecordingError(
                f"{path}: topic '{TOPIC}' is not a recording of this program: {_reason(error)}"
            ) from error
        if len(rows[-1]) != 8:
            raise RecordingError(
                f"{path}, message {number}: {len(rows[-1]) - 1} numbers in probe.position and probe.orientation, "
                "must be 3 and 4"
            )
    try:
        table = np.array(rows, dtype=np.float64).reshape(-1, 8)
    except (TypeError, ValueError) as error:
        raise RecordingError(f"{path}: topic '{TOPIC}' does not hold numbers: {_reason(error)}") from error
    return checked(_from_first(table[:, 0], True), table[:, 1:4], table[:, 4:8], _place(path))


def decoded_messages(path: Path) -> Iterator[Any]:
    """Messages of topic `contact`, decoded with the descriptor in the file, in file order.

    A file cut short ends early with a warning in the log; one without a readable message is a RecordingError.
    """
    from mcap.reader import NonSeekingReader
    from mcap_protobuf.decoder import DecoderFactory

    count = 0
    with path.open("rb") as file:
        try:
            reader = NonSeekingReader(
                file,
                validate_crcs=True,
                decoder_factories=[DecoderFactory()],
                record_size_limit=path.stat().st_size,  # a length beyond the file is damage, not a size to allocate
            )
            # file order: sorting by log time would hold everything back until the end, which may be damaged
            for _, _, _, message in reader.iter_decoded_messages(topics=[TOPIC], log_time_order=False):
                yield message
                count += 1
        except GeneratorExit:
            raise
        except Exception as error:  # the decoders fail in many ways on damaged bytes
            if count == 0:
                raise RecordingError(f"{path}: not a readable MCAP recording: {_reason(error)}") from error
            log.warning("%s is cut short or damaged (%s): %d messages read", path, _reason(error), count)
    if count == 0:
        raise RecordingError(f"{path}: holds no message of topic '{TOPIC}'")


def _place(path: Path, line_numbers: list[int] | None = None) -> Callable[[int], str]:
    def place(row: int) -> str:
        if line_numbers is None:
            return f"{path}, row {row}"
        return f"{path}, line {line_numbers[row]}" if row < len(line_numbers) else str(path)

    return place


def _from_first(t: Array, relative: bool) -> Array:
    """Times of results are since the epoch; the motion starts at its first row."""
    with np.errstate(invalid="ignore", over="ignore"):
        return t - t[0] if relative and len(t) else t


def _reason(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error)[:120]}" if str(error) else type(error).__name__
