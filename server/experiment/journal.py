"""Journal of a session, one event per line, synchronised to disk before the session continues.

A power failure loses no answer. Each line has its number and a checksum: lines lost or edited later are noticed.
"""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import IO, Annotated, Any, Final
from zlib import crc32

import msgspec

from softfinger.config.errors import ConfigError
from softfinger.config.files import make_write_error
from softfinger.config.words import format_value
from softfinger.drivers.closeable import Closeable

Entry = dict[str, Any]
NUMBER: Final = "entry"
CHECKSUM: Final = "crc32"
"""Keys of the number of an entry in the file, from 1, and of the checksum of the text before this key. Files of earlier
versions have none."""
_CHECKSUM_KEY: Final = f',"{CHECKSUM}":'.encode()
RESTORE_REMEDY: Final = "restore the file from a copy"
REPEAT_REMEDY: Final = "earlier answers are stored; correct it and repeat the command"
"""Remedy if a file of a session cannot be written."""
_DECODER: Final = msgspec.json.Decoder(dict)
JSON_ERRORS: Final = msgspec.DecodeError, UnicodeDecodeError, RecursionError
"""Errors of the decoder for damaged bytes."""
_START: Final = b'{"kind"'


class _Entry(msgspec.Struct):
    kind: str


class _Started(_Entry):
    dry_run: bool


class _Begun(_Entry):
    trial: int


class _Done(_Entry):
    trial: int
    practice: bool
    condition: str
    level: Annotated[float, msgspec.Meta(gt=0.0)]
    answer: str | float
    right: bool | None
    catch: bool = False


class _SurveyAnswer(_Entry):
    survey: str
    block: int
    condition: str | None
    question: str
    answer: str | float


_TYPES: Final[dict[str, type[_Entry]]] = {"started": _Started, "begun": _Begun, "done": _Done, "survey": _SurveyAnswer}
"""Keys that other modules read, by the kind of the entry."""


class MemoryJournal:
    """Entries in memory only, for a rehearsal."""

    def __init__(self) -> None:
        self.entries: Final = list[Entry]()

    def write(self, kind: str, **values: Any) -> None:
        self.entries.append({"kind": kind, **values})

    def entries_of(self, kind: str) -> list[Entry]:
        return [entry for entry in self.entries if entry["kind"] == kind]


class Journal(MemoryJournal, Closeable):
    """Append-only file; `entries` include the existing ones. Locked: a second session on the file is refused.

    Raises ConfigError if the file is damaged or another session writes to it.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self._file: IO[bytes] = open(path, "ab", buffering=0)  # noqa: SIM115 - until `close`
        try:
            self._lock()
            self.entries.extend(read(path))
            if path.stat().st_size and not path.read_bytes().endswith(b"\n"):
                self._file.write(b"\n")  # terminate a line that a crash cut short
            _sync_folder(path.parent)
        except BaseException:
            self.close()
            raise

    def write(self, kind: str, **values: Any) -> None:
        """Append an entry, which is on the disk when this returns. If it does not fit there, the file is unchanged."""
        numbered = {"kind": kind, NUMBER: len(self.entries) + 1, **values}
        values_text = msgspec.json.encode(numbered).removesuffix(b"}")
        line, descriptor = values_text + b"%s%d}\n" % (_CHECKSUM_KEY, crc32(values_text)), self._file.fileno()
        before = os.fstat(descriptor).st_size
        try:
            while line:  # an almost full disk accepts a part, and refuses the next write
                line = line[os.write(descriptor, line) :]
            os.fsync(descriptor)
        except OSError as error:
            os.ftruncate(descriptor, before)
            raise make_write_error(self.path, error, REPEAT_REMEDY) from error
        super().write(kind, **values)

    def close(self) -> None:
        """Close the file; may be called repeatedly."""
        self._file.close()

    def _lock(self) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise ConfigError(
                f"{self.path}: another session of this participant is running: wait until it ends"
            ) from error


def read(path: Path) -> list[Entry]:
    """Return the entries of a journal without numbers and checksums; empty if there is no file. Skip truncated lines.

    A crash truncates the last line, so it is at the end or followed by the entry `started` of the resumed session.
    Raises ConfigError if any other line is invalid, was edited, lacks a key, or if an entry is missing.
    """
    if not path.exists():
        return []
    entries, damaged = list[Entry](), 0
    for number, line in enumerate(path.read_bytes().split(b"\n"), 1):
        if not line:
            continue
        try:
            entry = _DECODER.decode(line)
        except JSON_ERRORS:
            start = line.rstrip(b"\0")[: len(_START)]  # after a power failure a file may end with zeros
            if not _START.startswith(start):
                raise ConfigError(f"{path}: line {number} is not an entry of a journal: {RESTORE_REMEDY}") from None
            damaged = number
            continue
        if damaged and entry.get("kind") != "started":
            raise ConfigError(f"{path}: line {damaged} is not an entry of a journal: {RESTORE_REMEDY}")
        damaged = 0
        location = f"{path}: line {number}"
        if entry.pop(CHECKSUM, None) not in (None, crc32(line.rpartition(_CHECKSUM_KEY)[0])):
            fault = f"{_describe([entry])} was edited later"
            remedy = f'or remove the key "{CHECKSUM}" from the line to continue with these values'
            raise ConfigError(f"{location}: {fault}: {RESTORE_REMEDY}, {remedy}")
        _check_number(location, entry.pop(NUMBER, None), entry, entries)
        try:
            kind = msgspec.convert(entry, _Entry).kind
            msgspec.convert(entry, _TYPES.get(kind, _Entry))
        except msgspec.ValidationError as error:
            raise ConfigError(f"{location}: {error}: {RESTORE_REMEDY}") from error
        entries.append(entry)
    return entries


def _check_number(location: str, number: Any, entry: Entry, earlier: list[Entry]) -> None:
    """Raise ConfigError if the number of an entry is not that of the next one."""
    expected = len(earlier) + 1
    if number in (None, expected):
        return
    fault, remedy = f"is entry {format_value(number)}, must be entry {expected}", RESTORE_REMEDY
    if isinstance(number, int) and number > expected:
        missing = f"entry {expected} is" if number == expected + 1 else f"entries {expected} to {number - 1} are"
        fault = f"{missing} missing between {_describe(earlier[-1:])} and {_describe([entry])}"
        line = msgspec.json.encode({"kind": "lost", NUMBER: expected}).decode()
        remedy += f", or insert a line {line} here for each missing entry to continue without it"
    raise ConfigError(f"{location}: {fault}: {remedy}")


def _describe(entries: list[Entry]) -> str:
    trial = next((f" of trial {entry['trial']}" for entry in entries if "trial" in entry), "")
    return next((f"'{entry.get('kind')}'{trial}" for entry in entries), "the start of the file")


def _sync_folder(folder: Path) -> None:
    """Synchronise the folder, and with it the name of a new file, to disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
