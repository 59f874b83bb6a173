"""Every wrench a device without hardware is given, kept: a log in memory behind the handle, and its file.

A driver's block of int64 words begins with the words here; its own follow from `WORDS` on. `write` is the driver's C
function for the servo. Python reads the log while the servo writes to it, without a lock.
"""

from __future__ import annotations

import logging
import math
import os
import time
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numba import types
from numpy.typing import NDArray

from softfinger.config.errors import RecordingError
from softfinger.drivers.base import OK, STALE
from softfinger.drivers.libc import IO_SIGNATURE
from softfinger.proxy.kernels.jit import c_function, jit
from softfinger.proxy.kernels.memory import exchange_int64, float64_at, int64_at

Array = NDArray[np.float64]

# Words of the block behind the handle. Kernels read these as constants; they are part of the code,
# and the kernel cache is keyed by the source, so they cannot go stale.
READS: Final = 0  # reads so far, counted by the driver
LOG: Final = 1  # address of the log, (capacity, 7) float64: read index, force, torque
CAPACITY: Final = 2
WRITES: Final = 3  # wrenches kept so far, overwritten ones included
ARMED: Final = 4
LOCK: Final = 5  # held for the few instructions that add to the log
NEXT_ROW: Final = 6  # counted up and wrapped, which is cheaper than a remainder
WORDS: Final = 7
ROW_BYTES: Final = 56

LOG_MIN_S: Final = 10.0
LOG_MARGIN: Final = 64
FORCE_ENDINGS: Final = (".csv", ".npz")
FORCE_COLUMNS: Final = ("read", "force[0]", "force[1]", "force[2]", "torque[0]", "torque[1]", "torque[2]")

log: Final = logging.getLogger(__name__)


class Written(NamedTuple):
    """Wrenches a device was given, oldest first: index (k,) of the read each one answers, -1 before the
    first, and force N, torque N m (k, 6)."""

    read: NDArray[np.int64]
    wrench: Array


def _append(handle: int, f0: float, f1: float, f2: float, t0: float, t1: float, t2: float) -> None:
    word = int64_at(handle)
    slot = word[NEXT_ROW]
    word[NEXT_ROW] = 0 if slot + 1 == word[CAPACITY] else slot + 1
    row = float64_at(word[LOG] + slot * ROW_BYTES)
    row[0] = float(word[READS] - 1)
    row[1] = f0
    row[2] = f1
    row[3] = f2
    row[4] = t0
    row[5] = t1
    row[6] = t2
    # an exchange and not a plain store: it keeps the count behind the row for a reader on any processor
    exchange_int64(handle + WRITES * 8, word[WRITES] + 1)


_keep: Any = jit(_append)


@c_function(IO_SIGNATURE)
def write(handle: int, wrench: Any) -> int:
    word = int64_at(handle)
    # Never wait here: who holds the lock is stopping the device, so refusing is right as well.
    if exchange_int64(handle + LOCK * 8, 1) != 0:
        return STALE
    armed = word[ARMED]
    if armed:
        _keep(handle, wrench[0], wrench[1], wrench[2], wrench[3], wrench[4], wrench[5])
    exchange_int64(handle + LOCK * 8, 0)
    if armed:
        return OK
    for k in range(6):
        if wrench[k] != 0.0:
            return STALE
    return OK


@c_function(types.int64(types.int64))
def silence(handle: int) -> int:
    """Keep one zero wrench and disarm; 0 when a write is under way just now and it must be tried again."""
    word = int64_at(handle)
    if exchange_int64(handle + LOCK * 8, 1) != 0:
        return 0
    if word[ARMED]:
        _keep(handle, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        word[ARMED] = 0
    exchange_int64(handle + LOCK * 8, 0)
    return 1


class WrenchLog:
    """The log of a device whose block is `word`; at least `rows` wrenches and those of 10 s are kept.

    `forces` names the file that `close` saves to, None for no file.
    """

    def __init__(self, word: NDArray[np.int64], rows: int, rate_hz: float, forces: str | None) -> None:
        self._path = _forces_path(forces) if forces else None
        self._word = word
        capacity = max(rows, math.ceil(LOG_MIN_S * rate_hz)) + LOG_MARGIN
        self._rows = np.full((capacity, 7), 0.0)  # written here, so that the loop meets no first-touch page fault
        word[LOG] = self._rows.ctypes.data
        word[CAPACITY] = capacity
        word[ARMED] = 1

    def stop(self) -> None:
        """Keep a zero and disarm. From any thread, any number of times."""
        while not silence.ctypes(self._word.ctypes.data):
            time.sleep(0.0001)  # a write holds the lock for some twenty instructions

    def close(self) -> None:
        """Stop, then save, if that was asked for and is not done."""
        self.stop()
        path, self._path = self._path, None
        if path is not None:
            self._save(path)

    @property
    def lost(self) -> int:
        """Wrenches kept once and overwritten since, because a run was longer than the log."""
        return max(0, int(self._word[WRITES]) - len(self._rows))

    def counts(self) -> dict[str, int]:
        """Reads, and wrenches taken."""
        return {"reads": int(self._word[READS]), "writes": int(self._word[WRITES])}

    def written(self) -> Written:
        """The wrenches kept, oldest first. While the servo runs: those that were complete just now."""
        before = int(self._word[WRITES])
        rows = self._rows.copy()
        after = int(self._word[WRITES])
        capacity = len(rows)
        # the row after the newest may be half overwritten while it is copied
        first = max(0, (after + 1 if self._word[ARMED] else after) - capacity)
        rows = rows[np.arange(first, before) % capacity] if first < before else rows[:0]
        return Written(rows[:, 0].astype(np.int64), rows[:, 1:].copy())

    def _save(self, path: Path) -> None:
        read, wrench = self.written()
        if self.lost:
            log.warning("%s holds the last %d wrenches; %d earlier ones were overwritten", path, len(read), self.lost)
        part = path.with_name(f".{path.name}.part")
        try:
            if path.suffix.lower() == ".csv":
                with part.open("w", encoding="ascii") as text:
                    text.write(",".join(FORCE_COLUMNS) + "\n")
                    for n, row in zip(read.tolist(), wrench.tolist(), strict=True):
                        text.write(",".join([str(n), *map(repr, row)]) + "\n")
            else:
                with part.open("wb") as file:
                    np.savez(file, read=read, force=wrench[:, :3], torque=wrench[:, 3:])
            os.replace(part, path)
        except OSError as error:
            part.unlink(missing_ok=True)
            raise RecordingError(f"{path}: the forces cannot be saved: {error.strerror or error}") from error


def _forces_path(name: str) -> Path:
    path = Path(name)
    if path.suffix.lower() not in FORCE_ENDINGS:
        raise RecordingError(f"forces = '{name}': must end in {' or '.join(FORCE_ENDINGS)}")
    if not path.parent.is_dir():
        raise RecordingError(f"forces = '{name}': there is no folder {path.parent}: create it first")
    return path
