"""Finished cases of a sweep in an MCAP file, written block by block and read to resume.

The topic `case` has one msgpack message per case: `{"key", "case", "result"}`. Every message is a chunk with a checksum
and is flushed with its block, so the file of a killed run is readable up to its last block.
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
from softfinger.config.files import follow_links, new_file, open_input
from softfinger.drivers.containers import mcap_messages

TOPIC: Final = "case"

log: Final = logging.getLogger(__name__)


class StoredResults:
    """Results by the key of their case: `by_key` contains the results in the file, `append` adds new ones."""

    def __init__(self, by_key: dict[str, Any], file: _ResultFile | None) -> None:
        self.by_key = by_key
        self._file = file

    def append(self, rows: Iterable[tuple[str, Any, Any]]) -> None:
        """Add key, case and result of each case of a block; on return, they are in the file if there is one."""
        for key, case, result in rows:
            self.by_key[key] = result
            if self._file is not None:
                self._file.add({"key": key, "case": case, "result": result})
        if self._file is not None:
            self._file.flush()


@contextmanager
def open_rows(path: Path | None) -> Iterator[StoredResults]:
    """Open the rows of a file, which is created if necessary; with None they are stored in memory only.

    A damaged file is read up to the damage, with a warning in the log. Raises RecordingError if the file cannot be read
    or written, has other contents, or is in use by another run.
    """
    if path is None:
        yield StoredResults({}, None)
        return
    try:
        with ExitStack() as files:
            target = follow_links(path)
            # Created if necessary, because a lock needs a file: of two runs that start at once, one is refused.
            os.close(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666))
            old = files.enter_context(open_input(target))
            _lock(old, path)
            if not os.path.samestat(os.fstat(old.fileno()), os.stat(target)):
                raise _in_use_error(path)
            size = os.fstat(old.fileno()).st_size
            finished = list(_read(path, old)) if size else []
            # The file is rewritten, since MCAP cannot append, and this also removes a damaged end.
            with new_file(target) as target_file:
                new = files.enter_context(open(os.dup(target_file.fileno()), "wb"))
                _lock(new, path)
                file = _ResultFile(path, new)
                for row in finished:
                    file.add(row)
                file.flush()
            try:
                yield StoredResults({row["key"]: row["result"] for row in finished}, file)
            finally:
                file.finish()
    except OSError as error:
        if isinstance(error, ConnectionError | TimeoutError):
            raise
        raise RecordingError(f"{path}: cannot be used for results: {error.strerror or error}") from error


def _lock(file: IO[bytes], path: Path) -> None:
    """Exclude other runs; the lock is released when the file is closed, for any end of the process."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise _in_use_error(path) from error


def _in_use_error(path: Path) -> RecordingError:
    return RecordingError(f"{path}: another run is writing to it: wait until it ends or choose another file")


def _read(path: Path, file: IO[bytes]) -> Iterator[dict[str, Any]]:
    """Yield the rows of the file up to the damage."""
    count, is_complete = 0, False
    try:
        for _, channel, message in mcap_messages(file, None):
            row = msgspec.msgpack.decode(message.data)
            if channel.topic != TOPIC or not isinstance(row, dict) or row.keys() != {"key", "case", "result"}:
                raise RecordingError(f"{path}: not a file of sweep results: name another, it would be overwritten")
            yield row
            count += 1
        is_complete = True
    except RecordingError:
        raise
    except GeneratorExit:
        return
    except Exception as error:  # the decoders fail in many ways on damaged bytes
        reason = f"{type(error).__name__}: {str(error)[:120]}"
        file.seek(0)
        if file.read(5) != b"\x89MCAP":
            raise RecordingError(f"{path}: not a file of sweep results ({reason}): name another") from error
        log.warning(
            "%s is truncated or damaged (%s): %d finished cases read, the remainder is ignored", path, reason, count
        )
    if is_complete and not count:
        log.info("%s has no finished case", path)


class _ResultFile:
    """MCAP file that is being written."""

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        from mcap.writer import CompressionType, IndexType, Writer

        self._path, self._file, self._count = path, file, 0
        # A chunk ends with the message that fills it. With a chunk size of one byte, every message is a chunk with a
        # checksum.
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
