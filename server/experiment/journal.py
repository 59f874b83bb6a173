"""What happened in a session, a line each, on the disk before the session goes on: a power cut takes no answer."""

from __future__ import annotations

import fcntl
import os
from pathlib import Path
from typing import IO, Any, Final

import msgspec

from softfinger.config.errors import ConfigError
from softfinger.server.closing import Closing

Entry = dict[str, Any]
_DECODER: Final = msgspec.json.Decoder(dict)


class Memory:
    """Entries that are kept nowhere: of a rehearsal."""

    def __init__(self) -> None:
        self.entries: Final = list[Entry]()

    def write(self, kind: str, **values: Any) -> None:
        """Add an entry."""
        self.entries.append({"kind": kind, **values})

    def of(self, kind: str) -> list[Entry]:
        """Entries of a kind, in order."""
        return [entry for entry in self.entries if entry["kind"] == kind]


class Journal(Memory, Closing):
    """A file that only grows; `entries` begin with those of before. One session at a time: others are refused.

    Raises ConfigError where the file is damaged or another session writes to it.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.path = path
        self._file: IO[bytes] = open(path, "ab", buffering=0)  # noqa: SIM115 - until `close`
        try:
            self._lock()
            self.entries.extend(read(path))
            if path.stat().st_size and not path.read_bytes().endswith(b"\n"):
                self._file.write(b"\n")  # behind a line that a crash cut short
            _sync_folder(path.parent)
        except BaseException:
            self.close()
            raise

    def write(self, kind: str, **values: Any) -> None:
        """Add an entry; it is on the disk when this returns. Of one that does not fit there, nothing stays."""
        line, descriptor = msgspec.json.encode({"kind": kind, **values}) + b"\n", self._file.fileno()
        before = os.fstat(descriptor).st_size
        try:
            while line:  # a disk that is nearly full takes a part, and refuses the next
                line = line[os.write(descriptor, line) :]
            os.fsync(descriptor)
        except OSError as error:
            os.ftruncate(descriptor, before)
            raise not_written(self.path, error) from error
        super().write(kind, **values)

    def close(self) -> None:
        """Any number of times."""
        self._file.close()

    def _lock(self) -> None:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise ConfigError(
                f"{self.path}: another session of this participant is running: wait for its end"
            ) from error


def read(path: Path) -> list[Entry]:
    """Entries of a journal; none where there is no file. A line that a crash cut short is left out.

    Such a line is the last one, or one before the entry `started` of the session that went on. Raises ConfigError for
    any other line that is no entry.
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
            raise ConfigError(f"{path}: line {damaged} is no entry of a journal: the file is damaged")
        damaged = 0
        entries.append(entry)
    return entries


def _sync_folder(folder: Path) -> None:
    """Have the file's name on the disk as well."""
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def not_written(path: Path, error: OSError) -> ConfigError:
    """What to say of a file of a session that the disk did not take."""
    return ConfigError(
        f"{path}: cannot be written: {error.strerror}: no answer before is lost; mend that and repeat the command"
    )
