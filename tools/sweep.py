"""Many cases of one computation: in threads here, on a local cluster or on dask workers elsewhere, resumable.

    run_cases(function, cases, label="limits")                                   threads of this process
    run_cases(function, cases, label="limits", scheduler="local")                processes of this machine
    run_cases(function, cases, label="limits", scheduler="tcp://127.0.0.1:8786") workers of a dask scheduler
    run_cases(function, cases, label="limits", results=Path("limits.mcap"))      goes on where the last run ended

A case is plain values, so is its result, and a result depends on nothing but its case: hence the same
bits from every scheduler, in every block size and after every interruption. Threads serve kernels that
release the GIL; what computes in Python needs processes.

A dask scheduler runs whatever it is sent and its traffic is not encrypted: name only one on a network
you trust.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import logging
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor, as_completed
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import msgspec

from softfinger.config.errors import ConfigError
from softfinger.proxy.kernels.jit.decorators import SOURCE_HASH
from softfinger.server.progress import progress
from softfinger.tools.sweep_results import open_rows

BLOCKS_PER_WORKER: Final = 8
"""So many blocks for each worker even out cases of unequal cost; dask takes about 1 ms to hand one out."""
BLOCK_MAX: Final = 100
"""Cases in a block at most: what an interruption can cost."""
CONNECT_S: Final = 10.0

Compute = Callable[[Sequence[Any]], Sequence[Any]]
"""Results of some cases, one each, in their order. A function of a module, so that workers can import it."""


def add_sweep_options(parser: argparse.ArgumentParser) -> None:
    """`--scheduler` and `--results`, which every command of many cases has."""
    group = parser.add_argument_group("where it is computed and kept")
    group.add_argument("--scheduler", metavar="ADDRESS", help="dask scheduler, or 'local' for processes here")
    group.add_argument("--results", type=Path, metavar="FILE.mcap", help="keeps finished cases; run again, it goes on")


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
    """Results of all cases, in their order, as msgpack gives them back (a tuple becomes a list).

    function   computes a block of cases
    cases      what msgspec can encode: mappings, structs, named tuples of numbers and text
    label      what the progress line calls it
    scheduler  None: threads; "local": a cluster of processes here; else the address of a dask scheduler
    results    MCAP file that keeps finished cases: those in it are not computed again
    block      cases handed out at once; by default as many as keep the workers evenly busy
    threads    how many compute at once without a scheduler, by default one on each processor; 1 for what is timed

    Raises ConfigError when the scheduler cannot be used, runs another version of this program or is lost, and
    RecordingError when the file cannot be; what `function` raises comes through, finished blocks are kept.
    """
    keys = [case_key(function, case) for case in cases]
    with open_rows(results) as rows:
        todo = {key: case for key, case in zip(keys, cases, strict=True) if key not in rows.done}
        if todo:
            finished = len(keys) - len(todo)
            with _workers(scheduler, threads) as workers, progress(label, len(keys)) as done:
                size = block or max(1, min(BLOCK_MAX, len(todo) // (BLOCKS_PER_WORKER * workers.number)))
                for block_keys, found in _in_blocks(workers, function, todo, size):
                    decoded = map(msgspec.msgpack.decode, found)
                    rows.append((key, todo[key], one) for key, one in zip(block_keys, decoded, strict=True))
                    finished += len(block_keys)
                    done(finished)
        return [rows.done[key] for key in keys]


def case_key(function: Compute, case: Any) -> str:
    """What a case is known by in a file of results: the function, its program's sources and the case's values."""
    digest = hashlib.sha256(f"{function.__module__}.{function.__qualname__} {SOURCE_HASH} ".encode())
    digest.update(msgspec.msgpack.encode(case, order="deterministic"))
    return digest.hexdigest()


def _compute(sources: str, function: Compute, cases: Sequence[Any]) -> list[bytes]:
    """What a worker does. Encoded here, so that a result is the same whether or not it travelled or was stored."""
    if sources != SOURCE_HASH:
        raise ConfigError(
            f"the dask worker on {os.uname().nodename} runs another version of softfinger: its sources have the hash "
            f"{SOURCE_HASH[:16]}, must be {sources[:16]}: install this version there"
        )
    return [msgspec.msgpack.encode(result) for result in function(cases)]


class _Workers(NamedTuple):
    """How many compute at once, how to hand out a call, and how to take its future when it is finished."""

    number: int
    submit: Callable[..., Any]
    completed: Callable[[Iterable[Any]], Iterable[Any]]


def _in_blocks(
    workers: _Workers, function: Compute, todo: Mapping[str, Any], size: int
) -> Iterator[tuple[list[str], list[bytes]]]:
    """Keys and encoded results of each block, in the order they are finished."""
    keys = list(todo)
    blocks = {}
    for first in range(0, len(keys), size):
        some = keys[first : first + size]
        blocks[workers.submit(_compute, SOURCE_HASH, function, [todo[key] for key in some])] = some
    for future in workers.completed(blocks):
        yield blocks[future], future.result()


@contextmanager
def _workers(scheduler: str | None, threads: int | None) -> Iterator[_Workers]:
    """What computes, ready to be handed work; what is not finished when the block ends is given up."""
    here = len(os.sched_getaffinity(0))
    if scheduler is None:
        number = threads or here
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
    logging.getLogger("distributed").setLevel(logging.WARNING)  # it tells of every connection
    with ExitStack() as opened:
        if scheduler == "local":
            address = opened.enter_context(
                distributed.LocalCluster(here, threads_per_worker=1, dashboard_address="127.0.0.1:0")
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
            raise ConfigError(f"--scheduler {scheduler}: it has no workers: start one with `dask worker {scheduler}`")
        # Not pure: dask would look for equal calls by hashing the arguments, which the keys have done already.
        completed = partial(distributed.as_completed, loop=client.loop)
        try:
            yield _Workers(number, partial(client.submit, pure=False), completed)
        except (CancelledError, distributed.KilledWorker, distributed.comm.CommClosedError) as error:
            reason = str(error).partition("\n")[0]
            raise ConfigError(
                f"--scheduler {scheduler}: lost while it computed ({reason}): see its log; the same command with "
                "--results FILE goes on where it ended"
            ) from error
