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
from softfinger.config.files import follow_links, open_input, write_new_file
from softfinger.drivers.containers import iter_mcap_messages

TOPIC: Final = "case"

log: Final = logging.getLogger(__name__)


class StoredResults:
    """Results by the key of their case in `by_key`; new ones are also written to the file if there is one."""

    def __init__(self, file: IO[bytes] | None = None) -> None:
        self.by_key: dict[str, Any] = {}
        self._file = file
        if file is not None:
            from mcap.writer import CompressionType, IndexType, Writer

            # A chunk ends with the message that fills it. With a chunk size of one byte, every message is a chunk with
            # a checksum.
            self._writer: Any = Writer(file, 1, CompressionType.NONE, IndexType.NONE)
            self._writer.start(profile="", library="softfinger")
            self._channel = self._writer.register_channel(TOPIC, "msgpack", schema_id=0)

    def append(self, rows: Iterable[tuple[str, Any, Any]]) -> None:
        """Add key, case and result of each case of a block; on return, they are in the file if there is one."""
        for key, case, result in rows:
            if self._file is not None:
                now, number = time.time_ns(), len(self.by_key) & 0xFFFFFFFF
                data = msgspec.msgpack.encode({"key": key, "case": case, "result": result})
                self._writer.add_message(self._channel, now, data, now, sequence=number)
            self.by_key[key] = result
        if self._file is not None:
            self._file.flush()

    def finish(self) -> None:
        if self._file is not None:
            self._writer.finish()
            self._file.flush()


@contextmanager
def open_rows(path: Path | None) -> Iterator[StoredResults]:
    """Open the rows of a file, which is created if necessary; with None they are stored in memory only.

    A damaged file is read up to the damage, with a warning in the log. Raises RecordingError if the file cannot be read
    or written, has other contents, or is in use by another run.
    """
    if path is None:
        yield StoredResults()
        return
    try:
        with ExitStack() as files:
            target = follow_links(path)
            # Created if necessary, because a lock needs a file: of two runs that start at once, one is refused.
            os.close(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o666))
            old = files.enter_context(open_input(target))
            _lock(old, path)
            if not os.path.samestat(os.fstat(old.fileno()), os.stat(target)):
                raise _make_in_use_error(path)
            size = os.fstat(old.fileno()).st_size
            finished = _read(path, old) if size else []
            # The file is rewritten, since MCAP cannot append, and this also removes a damaged end.
            with write_new_file(target) as target_file:
                new = files.enter_context(open(os.dup(target_file.fileno()), "wb"))
                _lock(new, path)
                results = StoredResults(new)
                results.append((row["key"], row["case"], row["result"]) for row in finished)
            try:
                yield results
            finally:
                results.finish()
    except OSError as error:
        if isinstance(error, ConnectionError | TimeoutError):
            raise
        raise RecordingError(f"{path}: cannot be used for results: {error.strerror or error}") from error


def _lock(file: IO[bytes], path: Path) -> None:
    """Exclude other runs; the lock is released when the file is closed, for any end of the process."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise _make_in_use_error(path) from error


def _make_in_use_error(path: Path) -> RecordingError:
    return RecordingError(f"{path}: another run is writing to it: wait until it ends or choose another file")


def _read(path: Path, file: IO[bytes]) -> list[dict[str, Any]]:
    """Return the rows of the file up to the damage."""
    rows: list[dict[str, Any]] = []
    try:
        for _, channel, message in iter_mcap_messages(file, None):
            row = msgspec.msgpack.decode(message.data)
            if channel.topic != TOPIC or not isinstance(row, dict) or row.keys() != {"key", "case", "result"}:
                raise RecordingError(f"{path}: not a file of sweep results: name another, it would be overwritten")
            rows.append(row)
        if not rows:
            log.info("%s has no finished case", path)
    except RecordingError:
        raise
    except Exception as error:  # the decoders fail in many ways on damaged bytes
        reason = f"{type(error).__name__}: {str(error)[:120]}"
        file.seek(0)
        if file.read(5) != b"\x89MCAP":
            raise RecordingError(f"{path}: not a file of sweep results ({reason}): name another") from error
        log.warning(
            "%s is truncated or damaged (%s): %d finished cases read, the remainder is ignored", path, reason, len(rows)
        )
    return rows
