"""Finished cases of a sweep in an MCAP file: kept block by block, read back to go on.

One msgpack message a case on the topic `case`: `{"key", "case", "result"}`. Every message has a chunk and
a checksum of its own and goes to the system with its block: what a killed run leaves behind is readable
up to its last block.
"""

from __future__ import annotations

import fcntl
import logging
import os
import time
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any, Final

import msgspec

from softfinger.config.errors import RecordingError
from softfinger.config.files import followed, new_file, open_input
from softfinger.drivers.containers import mcap_messages

TOPIC: Final = "case"

log: Final = logging.getLogger(__name__)


class Rows:
    """Results by the key of their case: `done`, which holds those of the file, and `append`, which keeps more."""

    def __init__(self, done: dict[str, Any], file: _File | None) -> None:
        self.done = done
        self._file = file

    def append(self, rows: Iterable[tuple[str, Any, Any]]) -> None:
        """Add key, case and result of each case of a block; with a file they are in it when this returns."""
        for key, case, result in rows:
            self.done[key] = result
            if self._file is not None:
                self._file.add({"key": key, "case": case, "result": result})
        if self._file is not None:
            self._file.flush()


@contextmanager
def open_rows(path: Path | None) -> Iterator[Rows]:
    """The rows of a file, which is made if need be; with None they are kept in memory only.

    A file cut short is read up to where it is whole, with a warning in the log. Raises RecordingError when
    the file cannot be read or written, is something else, or is in use by another run.
    """
    if path is None:
        yield Rows({}, None)
        return
    try:
        with ExitStack() as files:
            target = followed(path)
            # Made if need be, for there must be something to lock: of two runs that begin at once one is refused.
            os.close(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666))
            old = files.enter_context(open_input(target))
            _lock(old, path)
            if not os.path.samestat(os.fstat(old.fileno()), os.stat(target)):
                raise _in_use(path)
            size = os.fstat(old.fileno()).st_size
            kept = list(_read(path, old)) if size else []
            # Written anew beside the old one: MCAP has no appending, and a torn end goes this way too.
            with new_file(target) as begun:
                new = files.enter_context(open(os.dup(begun.fileno()), "wb"))
                _lock(new, path)
                file = _File(path, new)
                for row in kept:
                    file.add(row)
                file.flush()
            try:
                yield Rows({row["key"]: row["result"] for row in kept}, file)
            finally:
                file.finish()
    except OSError as error:
        if isinstance(error, ConnectionError | TimeoutError):
            raise
        raise RecordingError(f"{path}: cannot be used for results: {error.strerror or error}") from error


def _lock(file: IO[bytes], path: Path) -> None:
    """Keep other runs off; let go when the file is closed, however the process ends."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise _in_use(path) from error


def _in_use(path: Path) -> RecordingError:
    return RecordingError(f"{path}: another run is writing to it: wait for its end or name another file")


def _read(path: Path, file: IO[bytes]) -> Iterator[dict[str, Any]]:
    """Rows of the file, as far as it is whole."""
    count, whole = 0, False
    try:
        for _, channel, message in mcap_messages(file, None):
            row = msgspec.msgpack.decode(message.data)
            if channel.topic != TOPIC or not isinstance(row, dict) or row.keys() != {"key", "case", "result"}:
                raise RecordingError(f"{path}: not a file of sweep results: name another, it would be overwritten")
            yield row
            count += 1
        whole = True
    except RecordingError:
        raise
    except GeneratorExit:
        return
    except Exception as error:  # the decoders fail in many ways on damaged bytes
        reason = f"{type(error).__name__}: {str(error)[:120]}"
        file.seek(0)
        if file.read(5) != b"\x89MCAP":
            raise RecordingError(f"{path}: not a file of sweep results ({reason}): name another") from error
        log.warning("%s is cut short or damaged (%s): %d finished cases read, the rest is dropped", path, reason, count)
    if whole and not count:
        log.info("%s holds no finished case", path)


class _File:
    """An MCAP file being written."""

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        from mcap.writer import CompressionType, IndexType, Writer

        self._path, self._file, self._count = path, file, 0
        # A chunk ends with the message that fills it: at one byte every message is a chunk, with a checksum.
        self._writer: Any = Writer(file, 1, CompressionType.NONE, IndexType.NONE)
        self._writer.start(profile="", library="softfinger")
        self._channel = self._writer.register_channel(TOPIC, "msgpack", schema_id=0)

    def add(self, row: dict[str, Any]) -> None:
        now = time.time_ns()
        data = msgspec.msgpack.encode(row)
        self._writer.add_message(self._channel, now, data, now, sequence=self._count & 0xFFFFFFFF)
        self._count += 1

    def flush(self) -> None:
        self._file.flush()

    def finish(self) -> None:
        self._writer.finish()
        self._file.flush()
