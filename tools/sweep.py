"""Runner for many cases of one computation: in threads, on a local cluster or on dask workers elsewhere, resumable.

    run_cases(function, cases, label="limits")                                   threads of this process
    run_cases(function, cases, label="limits", scheduler="local")                processes of this machine
    run_cases(function, cases, label="limits", scheduler="tcp://127.0.0.1:8786") workers of a dask scheduler
    run_cases(function, cases, label="limits", results=Path("limits.mcap"))      resumes after the last run

Cases and results are plain values, and a result depends only on its case. Therefore it has the same bits with every
scheduler, in every block size and after every interruption. Threads suit kernels that release the GIL; computation in
Python needs processes.

A dask scheduler runs any code that it receives, and its traffic is not encrypted: use only one on a trusted network.

A file of results has the topic `case` with one msgpack message per case: `{"key", "case", "result"}`. Every message is
a chunk with a checksum and is flushed with its block, so the file of a killed run is readable up to its last block.
"""

from __future__ import annotations

import fcntl
import hashlib
import importlib
import logging
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor, as_completed
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import IO, Any, Final, NamedTuple

import msgspec

from softfinger.config.errors import ConfigError, RecordingError
from softfinger.config.files import follow_links, open_input, write_new_file
from softfinger.drivers.mcap_messages import iter_mcap_messages
from softfinger.proxy.kernels.jit.source_hash import SOURCE_HASH
from softfinger.server.progress import show_progress

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


BLOCKS_PER_WORKER: Final = 8
"""Blocks per worker, which balance cases of unequal cost; dask needs about 1 ms to submit one."""
BLOCK_MAX: Final = 100
"""Largest number of cases in a block, which an interruption can lose."""
CONNECT_S: Final = 10.0

Compute = Callable[[Sequence[Any]], Sequence[Any]]
"""Function of a module, so that workers can import it; returns the results of some cases, one each, in their order."""


def run_cases(
    function: Compute,
    cases: Sequence[Any],
    *,
    label: str,
    scheduler: str | None = None,
    results: Path | None = None,
    block: int | None = None,
    threads: int | None = None,
) -> list[Any]:
    """Return the results of all cases, in their order, as decoded from msgpack (a tuple becomes a list).

    function   computes a block of cases
    cases      values that msgspec can encode: mappings, structs, named tuples of numbers and text
    label      text of the progress line
    scheduler  None: threads; "local": a cluster of processes here; else the address of a dask scheduler
    results    MCAP file that stores finished cases; they are not computed again
    block      cases in a block; default: a size that balances the load of the workers
    threads    number of threads without a scheduler, default one per processor; 1 for timing

    Raises ConfigError if the scheduler cannot be used, runs another version of this program or is lost, and
    RecordingError if the file cannot be used. Errors of `function` are passed on; finished blocks are stored.
    """
    keys = [make_case_key(function, case) for case in cases]
    with open_rows(results) as rows:
        todo = {key: case for key, case in zip(keys, cases, strict=True) if key not in rows.by_key}
        if todo:
            finished = len(keys) - len(todo)
            with _start_workers(scheduler, threads) as workers, show_progress(label, len(keys)) as update:
                size = block or max(1, min(BLOCK_MAX, len(todo) // (BLOCKS_PER_WORKER * workers.number)))
                for block_keys, decoded_rows in _iterate_blocks(workers, function, todo, size):
                    decoded = map(msgspec.msgpack.decode, decoded_rows)
                    rows.append((key, todo[key], row) for key, row in zip(block_keys, decoded, strict=True))
                    finished += len(block_keys)
                    update(finished)
        return [rows.by_key[key] for key in keys]


def make_case_key(function: Compute, case: Any) -> str:
    """Return the key of a case in a file of results: a hash of the function, the program's sources and the values."""
    digest = hashlib.sha256(f"{function.__module__}.{function.__qualname__} {SOURCE_HASH} ".encode())
    digest.update(msgspec.msgpack.encode(case, order="deterministic"))
    return digest.hexdigest()


def _compute(sources: str, function: Compute, cases: Sequence[Any]) -> list[bytes]:
    """Compute cases in a worker. Results are encoded here, so that they do not depend on transport or storage."""
    if sources != SOURCE_HASH:
        raise ConfigError(
            f"the dask worker on {os.uname().nodename} runs another version of softfinger: its sources have the hash "
            f"{SOURCE_HASH[:16]}, must be {sources[:16]}: install this version there"
        )
    return [msgspec.msgpack.encode(result) for result in function(cases)]


class _Workers(NamedTuple):
    """Number of parallel workers, function that submits a call, and function that yields finished futures."""

    number: int
    submit: Callable[..., Any]
    completed: Callable[[Iterable[Any]], Iterable[Any]]


def _iterate_blocks(
    workers: _Workers, function: Compute, todo: Mapping[str, Any], size: int
) -> Iterator[tuple[list[str], list[bytes]]]:
    """Yield keys and encoded results of each block, in the order of completion."""
    keys = list(todo)
    blocks = {}
    for first in range(0, len(keys), size):
        some = keys[first : first + size]
        blocks[workers.submit(_compute, SOURCE_HASH, function, [todo[key] for key in some])] = some
    for future in workers.completed(blocks):
        yield blocks[future], future.result()


@contextmanager
def _start_workers(scheduler: str | None, threads: int | None) -> Iterator[_Workers]:
    """Yield workers that are ready for calls; unfinished calls are cancelled at the end of the block."""
    processors = len(os.sched_getaffinity(0))
    if scheduler is None:
        number = threads or processors
        pool = ThreadPoolExecutor(number, "sweep")
        try:
            yield _Workers(number, pool.submit, as_completed)
        finally:
            pool.shutdown(cancel_futures=True)
        return
    try:
        distributed: Any = importlib.import_module("distributed")
    except ImportError as error:
        raise ConfigError(f"--scheduler {scheduler}: dask is not installed: pip install 'softfinger[sweep]'") from error
    logging.getLogger("distributed").setLevel(logging.WARNING)  # it logs every connection
    with ExitStack() as opened:
        if scheduler == "local":
            address = opened.enter_context(
                distributed.LocalCluster(processors, threads_per_worker=1, dashboard_address="127.0.0.1:0")
            )
        elif "://" in scheduler:
            address = scheduler
        else:
            raise ConfigError(
                f"--scheduler {scheduler}: must be 'local' or the address of a dask scheduler such as "
                "tcp://127.0.0.1:8786"
            )
        try:
            client = opened.enter_context(distributed.Client(address, timeout=CONNECT_S, set_as_default=False))
        except (OSError, ValueError) as error:
            reason = str(error).partition("\n")[0] or type(error).__name__
            raise ConfigError(
                f"--scheduler {scheduler}: no dask scheduler there ({reason}): start one with `dask scheduler`"
            ) from error
        number = len(client.scheduler_info(n_workers=-1)["workers"])
        if not number:
            raise ConfigError(
                f"--scheduler {scheduler}: no workers are connected: start one with `dask worker {scheduler}`"
            )
        # Not pure: dask would hash the arguments to find equal calls, which the keys have done already.
        completed = partial(distributed.as_completed, loop=client.loop)
        try:
            yield _Workers(number, partial(client.submit, pure=False), completed)
        except (CancelledError, distributed.KilledWorker, distributed.comm.CommClosedError) as error:
            reason = str(error).partition("\n")[0]
            raise ConfigError(
                f"--scheduler {scheduler}: lost during a computation ({reason}): see its log; the same command with "
                "--results FILE continues from there"
            ) from error
