"""Recorded poses, read from CSV and from results of this program (CSV, npz, MCAP), and checked.

A recording is untrusted input. For any bytes, reading it returns poses or raises a RecordingError with the location of
the fault; nothing in it is ever unpickled.

The three formats share one file because they share the checks and the location of a fault.
"""

from __future__ import annotations

import logging
from array import array
from collections.abc import Callable, Iterator, Sequence
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import IO, Any, Final, NamedTuple

import msgspec
import numpy as np

from softfinger.config.arrays import Array
from softfinger.config.arrays.grids import open_npz
from softfinger.config.errors import RecordingError
from softfinger.config.files import open_input
from softfinger.config.words import suggest
from softfinger.drivers.mcap_messages import iter_mcap_messages

SHIPPED: Final = Path(__file__).resolve().parents[1] / "config" / "recordings"
"""Folder of the shipped recordings."""
POSE_COLUMNS: Final = ("t", "x", "y", "z", "qw", "qx", "qy", "qz")
RESULT_COLUMNS: Final = (
    "timestamp",
    *(f"probe.position[{i}]" for i in range(3)),
    *(f"probe.orientation[{i}]" for i in range(4)),
)
TOPIC: Final = "contact"
FINGER_TOPIC_PREFIX: Final = "finger/"
"""Topics of ticks: TOPIC of a single finger, FINGER_TOPIC_PREFIX and the name of one of several."""
DT_MIN_S: Final = 1e-6
DT_MAX_S: Final = 3600.0
"""Range from a thousandth of the shortest period to a pause longer than that of any recording."""
POSES_MAX: Final = 5_000_000
"""Maximum number of poses: 83 minutes at 1 kHz, 320 MB."""
LINE_MAX: Final = 1 << 16
"""Maximum bytes of a line of a CSV file; the longest of this program have 4 KB."""
BLOCK_BYTES: Final = 1 << 18
"""Bytes of a CSV file read at a time."""
ENDINGS: Final = (".csv", ".npz", ".mcap")

POSITION_MAX_M: Final = 1e6
STEP_MIN_S: Final = 1e-9  # the velocity over a shorter step is meaningless
NORM_MIN, NORM_MAX = 0.5, 2.0  # a quaternion outside was not meant to be a unit quaternion
NORM_ROUNDING: Final = 1e-15  # a quaternion this close to unit norm was normalised before, and is not changed

_ROWS: Final = msgspec.json.Decoder(list[list[float]])

log: Final = logging.getLogger(__name__)


class Poses(NamedTuple):
    """Recorded motion.

    t            (N,)    s  strictly increasing
    position     (N, 3)  m
    orientation  (N, 4)     unit quaternions w, x, y, z, fingertip to world; signs continuous from row to row
    """

    t: Array
    position: Array
    orientation: Array


def load_poses(recording: str | Path, finger: str = "") -> Poses:
    """Read a file, or a shipped recording by its name.

    Parameters
    ----------
    recording
        The ending determines the format: .csv (`t,x,y,z,qw,qx,qy,qz` in s, m and unit quaternions, in any column
        order, or a results file), .npz (results) or .mcap (a recording of this program; a truncated one is read up
        to the damage, with a warning in the log).
    finger
        Name of the finger to read from an MCAP recording of several.

    Returns
    -------
    Poses
        Times of results start at their first row. Times of an MCAP recording are multiples of the loop's period, so
        that a replay at the same rate plays one pose per tick.

    Raises
    ------
    RecordingError
        If the recording cannot be used.
    """
    path = find_recording(recording)
    readers: dict[str, Callable[[Path], Poses]] = {
        ".csv": _read_csv,
        ".npz": _read_npz,
        ".mcap": lambda path: _read_mcap(path, finger),
    }
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise RecordingError(f"{path}: unknown kind of recording: give it one of the suffixes {', '.join(ENDINGS)}")
    try:
        return reader(path)
    except OSError as error:
        raise RecordingError(f"{path}: cannot be read: {error.strerror or error}") from error
    except MemoryError as error:
        raise RecordingError(f"{path}: does not fit in memory, or its header is damaged") from error


def list_shipped_recordings() -> list[str]:
    return sorted(path.stem for path in SHIPPED.glob("*.csv"))


def find_recording(recording: str | Path) -> Path:
    """Return the file for a path or a shipped name (with or without .csv); raises RecordingError."""
    try:
        path = Path(recording)
        if path.exists():
            return path
    except (ValueError, OSError, TypeError) as error:  # too long, contains a NUL, or is no name
        raise RecordingError(f"recording {str(recording)[:80]!r} is not a usable file name: {error}") from error
    names = list_shipped_recordings()
    name = str(recording).removesuffix(".csv")
    if name in names:
        return SHIPPED / f"{name}.csv"
    if path.suffix or path.name != str(recording):
        raise RecordingError(
            f"recording {str(recording)!r}: no such file{_similar_file(path)}; "
            "`softfinger recordings` lists the shipped ones"
        )
    raise RecordingError(
        f"recording '{recording}' is neither a file nor a shipped recording{suggest(name, names)}; "
        f"shipped are {', '.join(names)}"
    )


def _similar_file(path: Path) -> str:
    """Return a hint for a missing file: a similar name in its folder."""
    try:
        return suggest(path.name, [file.name for file in path.parent.iterdir() if file.suffix == path.suffix])
    except OSError:
        return ""


def check_poses(t: Array, position: Array, orientation: Array, locate: Callable[[int], str]) -> Poses:
    """Return checked poses from raw columns (N,), (N, 3), (N, 4).

    Values are finite, times increase, and quaternions are normalised and continuous in sign.

    `locate(row)` returns the location of a row for the message of RecordingError.
    """
    if len(t) < 2:
        raise RecordingError(f"{locate(0)}: {len(t)} poses, at least 2 are needed")
    values = np.column_stack((t, position, orientation))
    finite = np.isfinite(values)
    if not finite.all():
        row, column = (int(i) for i in np.argwhere(~finite)[0])
        raise RecordingError(
            f"{locate(row)}, column '{POSE_COLUMNS[column]}': {values[row, column]} is not a finite number"
        )
    far = np.abs(position) > POSITION_MAX_M
    if far.any():
        row, column = (int(i) for i in np.argwhere(far)[0])
        raise RecordingError(
            f"{locate(row)}, column '{'xyz'[column]}': {position[row, column]:g} m is outside "
            f"{-POSITION_MAX_M:g} to {POSITION_MAX_M:g} m: positions are in metres"
        )
    with np.errstate(over="ignore"):  # an infinite norm or step is rejected below
        step = np.diff(t)
        norm = np.sqrt(np.sum(orientation**2, axis=1))
    late = step < STEP_MIN_S
    if late.any():
        row = int(np.argmax(late)) + 1
        raise RecordingError(
            f"{locate(row)}, column 't': {t[row]:.9g} s does not follow {t[row - 1]:.9g} s: times must increase"
        )
    odd = ~((norm >= NORM_MIN) & (norm <= NORM_MAX))
    if odd.any():
        row = int(np.argmax(odd))
        raise RecordingError(
            f"{locate(row)}, columns 'qw' to 'qz': quaternion of norm {norm[row]:.6g}, "
            f"must be 1 (accepted and normalised: {NORM_MIN:g} to {NORM_MAX:g})"
        )
    unit = orientation / np.where(np.abs(norm - 1.0) < NORM_ROUNDING, 1.0, norm)[:, None]
    flip = np.sum(unit[1:] * unit[:-1], axis=1) < 0.0
    sign = np.concatenate(([1.0], np.cumprod(np.where(flip, -1.0, 1.0))))
    return Poses(np.array(t), np.array(position), unit * sign[:, None])


def _read_csv(path: Path) -> Poses:
    with open_input(path) as file:
        first = next(_iter_lines(path, file, 1), "")
        return _read_rows(path, first, file)


def _iter_lines(path: Path, file: IO[bytes], number: int) -> Iterator[str]:
    """Yield the text of each line; `number` is that of the first one, for messages."""
    while line := file.readline(LINE_MAX):
        if len(line) == LINE_MAX:
            raise RecordingError(f"{path}, line {number}: longer than {LINE_MAX:,} bytes: this is not a table of poses")
        try:
            yield line.decode("utf-8-sig" if number == 1 else "utf-8").rstrip("\r\n")
        except UnicodeDecodeError as error:
            raise RecordingError(f"{path}, line {number}: not a text file (not UTF-8)") from error
        number += 1


def _read_rows(path: Path, first: str, file: IO[bytes]) -> Poses:
    names = [name.strip() for name in first.split(",")]
    columns = RESULT_COLUMNS if set(RESULT_COLUMNS) <= set(names) else POSE_COLUMNS
    missing = [name for name in columns if names.count(name) != 1]
    if missing:
        raise RecordingError(
            f"{path}, line 1: column(s) {', '.join(missing)} missing or duplicate: "
            f"the header must contain {','.join(POSE_COLUMNS)} (other columns are ignored); "
            "`softfinger import` converts other tables"
        )
    index = [names.index(name) for name in columns]
    numbers, values, number = array("q"), array("d"), 2
    while block := file.read(BLOCK_BYTES) + file.readline(LINE_MAX):
        rows = _parse_block(block, len(names))
        if rows is not None:
            _check_count(path, len(numbers) + len(rows) - 1)
            numbers.extend(range(number, number + len(rows)))
            values.frombytes(rows[:, index].tobytes())
            number += len(rows)
            continue
        for line in _iter_lines(path, BytesIO(block), number):
            if line.strip():
                _check_count(path, len(numbers))
                numbers.append(number)
                values.extend(_parse_row(f"{path}, line {number}", line, names, index))
            number += 1
    table = np.frombuffer(values).reshape(-1, len(columns))
    locate = _make_locator(path, numbers)
    return check_poses(
        _subtract_first_time(table[:, 0], columns is RESULT_COLUMNS), table[:, 1:4], table[:, 4:8], locate
    )


def _parse_block(lines: bytes, width: int) -> Array | None:
    """Return rows (n, width) of lines that form a JSON list without its brackets; else None, even for valid lines.

    Four times as fast as line by line.
    """
    text = lines.replace(b"\r\n", b"\n")
    if any(letter in text for letter in (b"[", b" ", b"\t", b"\r")):
        return None
    text = text.replace(b"-0,", b"-0.0,").replace(b"-0\n", b"-0.0\n")  # JSON's -0 is an integer, which has no sign
    try:
        rows = np.array(_ROWS.decode(b"[[" + text.removesuffix(b"\n").replace(b"\n", b"],[") + b"]]"))
    except (msgspec.DecodeError, ValueError):
        return None
    return rows if rows.shape[1:] == (width,) else None


def _parse_row(location: str, line: str, names: Sequence[str], index: Sequence[int]) -> Iterator[float]:
    """Yield the numbers of a line in the columns `index`; RecordingError with `location` if one is not a number."""
    cells = line.split(",")
    if len(cells) != len(names):
        raise RecordingError(f"{location}: {len(cells)} values, but the header has {len(names)} columns")
    for column in index:
        try:
            yield float(cells[column])
        except ValueError as error:
            raise RecordingError(
                f"{location}, column '{names[column]}': {cells[column][:40]!r} is not a number"
            ) from error


def _read_npz(path: Path) -> Poses:
    columns = []
    try:
        with open_input(path) as file:
            archive = open_npz(file)
            for name, shape in (("timestamp", ()), ("probe.position", (3,)), ("probe.orientation", (4,))):
                array_found = archive[name]
                if (
                    array_found.dtype.kind not in "fiu"
                    or array_found.shape[1:] != shape
                    or array_found.ndim != 1 + len(shape)
                ):
                    raise RecordingError(
                        f"{path}, array '{name}': {array_found.dtype} of shape {array_found.shape}, "
                        f"must be numbers of shape {('N', *shape)}"
                    )
                _check_count(path, len(array_found) - 1)
                columns.append(array_found.astype(np.float64))
    except (RecordingError, OSError, MemoryError):
        raise
    except Exception as error:  # the decoders of zip and npy fail in many ways on damaged bytes
        raise RecordingError(
            f"{path}: not a readable results file: {_describe_error(error)}: it must be an .npz with timestamp, "
            "probe.position and probe.orientation"
        ) from error
    t, position, orientation = columns
    if not len(t) == len(position) == len(orientation):
        raise RecordingError(f"{path}: arrays of {len(t)}, {len(position)} and {len(orientation)} rows, must be equal")
    return check_poses(_subtract_first_time(t, True), position, orientation, _make_locator(path))


def _read_mcap(path: Path, finger: str) -> Poses:
    values = array("d")
    topic = f"{FINGER_TOPIC_PREFIX}{finger}" if finger else TOPIC
    for number, message in enumerate(decode_messages(path, topic)):
        _check_count(path, number)
        try:
            row = message.timestamp, message.tick, message.dt, *message.probe.position, *message.probe.orientation
        except (AttributeError, TypeError) as error:
            raise RecordingError(
                f"{path}: topic '{topic}' is not a recording of this program: {_describe_error(error)}"
            ) from error
        if len(row) != 10:
            raise RecordingError(
                f"{path}, message {number}: {len(row) - 3} numbers in probe.position and probe.orientation, "
                "must be 3 and 4"
            )
        try:
            values.extend(row)
        except (TypeError, ValueError) as error:
            raise RecordingError(
                f"{path}: topic '{topic}' does not contain numbers: {_describe_error(error)}"
            ) from error
    table = np.frombuffer(values).reshape(-1, 10)
    return check_poses(
        _compute_times(table[:, 0], table[:, 1], table[:, 2]), table[:, 3:6], table[:, 6:10], _make_locator(path)
    )


def _compute_times(timestamp: Array, tick: Array, dt: Array) -> Array:
    """Return times (n,) s of ticks, from the first: each step in whole periods of the loop, plus one per missing tick.

    Return times relative to the first timestamp if ticks or steps cannot be from a loop.
    """
    with np.errstate(invalid="ignore", over="ignore"):
        tick_steps = np.diff(tick)
        is_usable = len(dt) > 1 and bool(np.all((dt > DT_MIN_S) & (dt < DT_MAX_S)) and np.all(tick_steps >= 1))
    if not is_usable:
        return _subtract_first_time(timestamp, True)
    period = float(dt.min())
    periods = tick_steps - 1.0 + np.maximum(1.0, np.rint(dt[1:] / period))
    return np.concatenate(([0.0], np.cumsum(periods))) / find_rate(period)


@cache
def find_rate(period_s: float) -> float:
    """Return the roundest rate (Hz) with this period to the nanosecond, as in the loop: the rate in its rig."""
    nanoseconds = round(period_s * 1e9)
    for digits in range(7):
        rate = round(1e9 / nanoseconds, digits)
        if round(1e9 / rate) == nanoseconds:
            return rate
    return 1e9 / nanoseconds


def decode_messages(path: Path, topic: str = TOPIC) -> Iterator[Any]:
    """Yield the messages of a topic, decoded with the descriptor in the file, in file order.

    A truncated file ends early, with a warning in the log. Raises RecordingError if no message is readable.
    """
    from mcap_protobuf.decoder import DecoderFactory

    count = 0
    factory = DecoderFactory()
    with open_input(path) as file:
        try:
            for schema, channel, message in iter_mcap_messages(file, topic):
                decode = factory.decoder_for(channel.message_encoding, schema)
                if decode is None:
                    raise ValueError(f"messages are encoded as {channel.message_encoding[:20]!r}, must be protobuf")
                yield decode(message.data)
                count += 1
        except GeneratorExit:
            raise
        except Exception as error:  # the decoders fail in many ways on damaged bytes
            if count == 0:
                raise RecordingError(f"{path}: not a readable MCAP recording: {_describe_error(error)}") from error
            log.warning("%s is truncated or damaged (%s): %d messages read", path, _describe_error(error), count)
    if count == 0:
        raise RecordingError(f"{path}: has no message on topic '{topic}'")


def _check_count(path: Path, before: int) -> None:
    """Raise RecordingError if `before` poses were read and another would exceed POSES_MAX."""
    if before >= POSES_MAX:
        raise RecordingError(f"{path}: more than {POSES_MAX:,} poses, the limit for reading: split it")


def _make_locator(path: Path, line_numbers: Sequence[int] | None = None) -> Callable[[int], str]:
    def locate(row: int) -> str:
        if line_numbers is None:
            return f"{path}, row {row}"
        return f"{path}, line {line_numbers[row]}" if row < len(line_numbers) else str(path)

    return locate


def _subtract_first_time(t: Array, relative: bool) -> Array:
    """Return times from the first row if `relative`, because results have times since the epoch."""
    with np.errstate(invalid="ignore", over="ignore"):
        return t - t[0] if relative and len(t) else t


def _describe_error(error: Exception) -> str:
    return f"{type(error).__name__}: {str(error)[:120]}" if str(error) else type(error).__name__
