"""Journal of a session, one event per line, synchronised to disk before the session continues.

A power failure loses no answer.
"""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import IO, Any, Final

import msgspec

from softfinger.config.errors import ConfigError
from softfinger.drivers.closing import Closeable

Entry = dict[str, Any]
_DECODER: Final = msgspec.json.Decoder(dict)


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
        line, descriptor = msgspec.json.encode({"kind": kind, **values}) + b"\n", self._file.fileno()
        before = os.fstat(descriptor).st_size
        try:
            while line:  # an almost full disk accepts a part, and refuses the next write
                line = line[os.write(descriptor, line) :]
            os.fsync(descriptor)
        except OSError as error:
            os.ftruncate(descriptor, before)
            raise make_write_error(self.path, error) from error
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
    """Return the entries of a journal; empty if there is no file. Truncated lines are skipped.

    A crash truncates the last line, so it is at the end or followed by the entry `started` of the resumed session.
    Raises ConfigError if any other line is invalid.
    """
    if not path.exists():
        return []
    entries, damaged = list[Entry](), 0
    for number, line in enumerate(path.read_bytes().split(b"\n"), 1):
        if not line:
            continue
        try:
            entry = _DECODER.decode(line)
        except (msgspec.DecodeError, UnicodeDecodeError):
            damaged = number
            continue
        if damaged and entry.get("kind") != "started":
            raise ConfigError(f"{path}: line {damaged} is not an entry of a journal: the file is damaged")
        damaged = 0
        entries.append(entry)
    return entries


def _sync_folder(folder: Path) -> None:
    """Synchronise the folder, and with it the name of a new file, to disk."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_write_error(path: Path, error: OSError) -> ConfigError:
    """Return the error for a file of a session that the disk did not accept."""
    return ConfigError(
        f"{path}: cannot be written: {error.strerror}: earlier answers are stored; correct it and repeat the command"
    )
