"""Log of every wrench written to a device without hardware: memory behind the handle, and its file.

A driver's block starts with the fields of `LOG`; the fields of the driver follow. `write` is the driver's C function
for the servo. Python reads the log without a lock while the servo writes to it.
"""

from __future__ import annotations

import logging
import math
import time
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from softfinger.config.arrays import Array
from softfinger.config.errors import RecordingError
from softfinger.config.files import write_new_file
from softfinger.drivers.base import OK, WITHHELD
from softfinger.drivers.block import Block, BlockDevice, address, counter, lay_out, try_lock, unlock, word
from softfinger.drivers.samples import is_zero
from softfinger.drivers.system.libc import IO_SIGNATURE
from softfinger.proxy.kernels.jit.decorators import PLAIN, c_function, jit
from softfinger.proxy.kernels.jit.memory import exchange_int64, float64_at, int64_at

ROW_BYTES: Final = 56

LOG_MIN_S: Final = 10.0
LOG_MARGIN: Final = 64
FORCE_ENDINGS: Final = (".csv", ".npz")
FORCE_COLUMNS: Final = ("read", "force[0]", "force[1]", "force[2]", "torque[0]", "torque[1]", "torque[2]")

_ZERO: Final = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

log: Final = logging.getLogger(__name__)


class LoggedWrenches(NamedTuple):
    """Logged wrenches, oldest first.

    read    (k,)         index of the preceding read, -1 before the first
    wrench  (k, 6)       force N, torque N m
    """

    read: NDArray[np.int64]
    wrench: Array


class Fields(NamedTuple):
    """Fields of the log; the fields of the driver follow."""

    reads: Annotated[int, counter("number of reads; written by the driver")]
    writes: Annotated[int, counter("number of stored wrenches, including overwritten ones")]
    log: Annotated[int, address("(capacity, 7) float64: read index, force, torque")]
    capacity: Annotated[int, word("rows of the log")]
    armed: Annotated[int, word("whether wrenches are stored")]
    lock: Annotated[int, word("lock: set while a wrench is appended")]
    next_row: Annotated[int, word("row of the next wrench; wrapped by comparison, which is cheaper than a remainder")]


LOG: Final = lay_out(Fields)


@jit
def _append_row(handle: int, wrench: Any) -> None:
    at = int64_at(handle)
    slot = at[LOG.next_row]
    at[LOG.next_row] = 0 if slot + 1 == at[LOG.capacity] else slot + 1
    row = float64_at(at[LOG.log] + slot * ROW_BYTES)
    row[0] = float(at[LOG.reads] - 1)
    for k in range(6):
        row[1 + k] = wrench[k]
    # an exchange instead of a plain store: it orders the count after the row, for a reader on any processor
    exchange_int64(handle + LOG.writes * 8, at[LOG.writes] + 1)


@c_function(IO_SIGNATURE)
def write(handle: int, wrench: Any) -> int:
    at = int64_at(handle)
    if not try_lock(handle, LOG.lock):
        return WITHHELD
    armed = at[LOG.armed]
    if armed:
        _append_row(handle, wrench)
    unlock(handle, LOG.lock)
    if armed:
        return OK
    return OK if is_zero(wrench, 6) else WITHHELD


@c_function(types.int64(types.int64))
def disarm_and_zero(handle: int) -> int:
    """Log a zero wrench and disarm. Return 1, or 0 if a write is in progress and the call must be repeated."""
    at = int64_at(handle)
    if not try_lock(handle, LOG.lock):
        return 0
    if at[LOG.armed]:
        _append_row(handle, _ZERO)
        at[LOG.armed] = 0
    unlock(handle, LOG.lock)
    return 1


class LoggedDevice(BlockDevice):
    """Device that logs the written wrenches in its block, which starts with LOG.

    The log has room for at least `rows` wrenches and 10 s. `forces` is the file that `close` writes; None for no file.
    """

    def __init__(self, block: Block, rows: int, rate_hz: float, forces: str | None) -> None:
        self._path = Path(forces) if forces else None
        if self._path is not None and self._path.suffix.lower() not in FORCE_ENDINGS:
            raise RecordingError(f"forces = '{forces}': must end in {' or '.join(FORCE_ENDINGS)}")
        if self._path is not None and not self._path.parent.is_dir():
            raise RecordingError(f"forces = '{forces}': the folder {self._path.parent} does not exist: create it first")
        self._block, word = block, block.word
        capacity = max(rows, math.ceil(LOG_MIN_S * rate_hz)) + LOG_MARGIN
        self._rows = np.full((capacity, 7), 0.0)  # written here, so that the loop causes no page fault on first access
        block.set_address(LOG.log, self._rows)
        word[LOG.capacity] = capacity
        word[LOG.armed] = 1

    def stop(self) -> None:
        """Log a zero and disarm. May be called from any thread, repeatedly."""
        if PLAIN:  # without compilation no loop writes concurrently
            self._block.word[LOG.armed] = 0
            return
        while not disarm_and_zero.ctypes(self._block.handle):
            time.sleep(0.0001)  # a write has the lock for about twenty instructions

    def close(self) -> None:
        """Stop, then save the file if there is one to save."""
        self.stop()
        path, self._path = self._path, None
        if path is not None:
            self._save(path)

    @property
    def overwritten_count(self) -> int:
        """Number of wrenches overwritten because the run was longer than the log."""
        return max(0, int(self._block.word[LOG.writes]) - len(self._rows))

    def read_log(self) -> LoggedWrenches:
        """Return the logged wrenches, oldest first; while the servo runs, up to the last complete one."""
        before = int(self._block.word[LOG.writes])
        rows = self._rows.copy()
        after = int(self._block.word[LOG.writes])
        capacity = len(rows)
        # the row after the latest may be half overwritten during the copy
        first = max(0, (after + 1 if self._block.word[LOG.armed] else after) - capacity)
        rows = rows[np.arange(first, before) % capacity] if first < before else rows[:0]
        return LoggedWrenches(rows[:, 0].astype(np.int64), rows[:, 1:].copy())

    def _save(self, path: Path) -> None:
        read, wrench = self.read_log()
        if self.overwritten_count:
            log.warning(
                "%s has the last %d wrenches; %d earlier ones were overwritten", path, len(read), self.overwritten_count
            )
        try:
            with write_new_file(path) as file:
                if path.suffix.lower() == ".csv":
                    file.write((",".join(FORCE_COLUMNS) + "\n").encode())
                    for n, row in zip(read.tolist(), wrench.tolist(), strict=True):
                        file.write((",".join([str(n), *map(repr, row)]) + "\n").encode())
                else:
                    np.savez(file, read=read, force=wrench[:, :3], torque=wrench[:, 3:])
        except OSError as error:
            raise RecordingError(f"{path}: the forces cannot be saved: {error.strerror or error}") from error
