"""A recording as a device: it senses the recorded poses and keeps every wrench it is given.

Read number n gives sample n, whatever the clock does, so a run is reproducible to the bit. The two
C functions share one block of int64 words with Python; its address is the device's handle.
"""

from __future__ import annotations

import logging
import math
import os
import time
from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import msgspec
import numpy as np
from numba import types
from numpy.typing import NDArray

from softfinger.config.errors import RecordingError
from softfinger.config.schema import said
from softfinger.drivers.base import END, OK, STALE, Device, DeviceInfo, DeviceIO
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import Array, close_loop, resample
from softfinger.proxy.kernels.jit import c_function, jit
from softfinger.proxy.kernels.memory import exchange_int64, float64_at, int64_at

# Words of the block behind the handle. Kernels read these as constants; they are part of the code,
# and the kernel cache is keyed by the source, so they cannot go stale.
SAMPLES: Final = 0  # address of the samples, (count, 7) float64
COUNT: Final = 1
LOOP: Final = 2
READS: Final = 3  # reads so far
LOG: Final = 4  # address of the log, (capacity, 7) float64: read index, force, torque
CAPACITY: Final = 5
WRITES: Final = 6  # wrenches kept so far, overwritten ones included
ARMED: Final = 7
LOCK: Final = 8  # held for the few instructions that add to the log
PERIOD: Final = 9  # s, a float64 in this word
NEXT_SAMPLE: Final = 10  # counted up and wrapped, which is cheaper than a remainder
NEXT_ROW: Final = 11
WORDS: Final = 12

LOG_MIN_S: Final = 10.0
LOG_MARGIN: Final = 64
FORCE_ENDINGS: Final = (".csv", ".npz")
# A recording feels nothing, so it sets no limit of its own: the rig's guard is what limits.
FORCE_MAX_N: Final = 1e3
TORQUE_MAX_NM: Final = 1e2
STIFFNESS_MAX_N_PER_M: Final = 1e6
DAMPING_MAX_NS_PER_M: Final = 1e3
FORCE_COLUMNS: Final = ("read", "force[0]", "force[1]", "force[2]", "torque[0]", "torque[1]", "torque[2]")

log: Final = logging.getLogger(__name__)


class Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """What a rig's [device] table may say for `driver = "replay"`."""

    recording: Annotated[str, said("file (.csv, .npz, .mcap) or name of a shipped recording", "press-roll-spin-drag")]
    loop: Annotated[bool, said("start again at the end, over a smooth return; false: stop after one pass")] = True
    forces: Annotated[str | None, said("file (.csv or .npz) for the wrenches written, saved on close")] = None


class Written(NamedTuple):
    """Wrenches a replay was given, oldest first: index (k,) of the read each one answers, -1 before the
    first, and force N, torque N m (k, 6)."""

    read: NDArray[np.int64]
    wrench: Array


_CPointer: Any = types.CPointer
_IO_SIGNATURE: Final[Any] = types.int64(types.int64, _CPointer(types.float64))


def _append(handle: int, f0: float, f1: float, f2: float, t0: float, t1: float, t2: float) -> None:
    word = int64_at(handle)
    slot = word[NEXT_ROW]
    word[NEXT_ROW] = 0 if slot + 1 == word[CAPACITY] else slot + 1
    row = float64_at(word[LOG] + slot * 56)
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


@c_function(_IO_SIGNATURE)
def _read(handle: int, sample: Any) -> int:
    word = int64_at(handle)
    n = word[READS]
    word[READS] = n + 1
    status = OK
    index = word[NEXT_SAMPLE]
    if index < word[COUNT]:
        word[NEXT_SAMPLE] = index + 1
    elif word[LOOP]:
        index = 0
        word[NEXT_SAMPLE] = 1
    else:
        n = index = word[COUNT] - 1
        status = END
    pose = float64_at(word[SAMPLES] + index * 56)
    for k in range(7):
        sample[k] = pose[k]
    sample[7] = n * float64_at(handle)[PERIOD]
    sample[8] = 0.0
    return status


@c_function(_IO_SIGNATURE)
def _write(handle: int, wrench: Any) -> int:
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
def _silence(handle: int) -> int:
    """Keep one zero wrench and disarm; 0 when a write is under way just now and it must be tried again."""
    word = int64_at(handle)
    if exchange_int64(handle + LOCK * 8, 1) != 0:
        return 0
    if word[ARMED]:
        _keep(handle, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
        word[ARMED] = 0
    exchange_int64(handle + LOCK * 8, 0)
    return 1


class Replay(Device):
    """A recording at the servo's rate; what is written to it is kept and can be read with `written`.

    Not looped, every pass's wrenches are kept; looped, at least those of the last pass and of the
    last 10 s. Once stopped it stays disarmed: the last wrench kept is zero.
    """

    def __init__(self, options: Options, rate_hz: float) -> None:
        self._path = _forces_path(options.forces) if options.forces else None
        samples = resample(load_poses(options.recording), rate_hz)
        self.samples: Array = np.ascontiguousarray(close_loop(samples, rate_hz) if options.loop else samples)
        """Poses (M, 7) that the reads return in turn."""
        capacity = max(len(self.samples), math.ceil(LOG_MIN_S * rate_hz)) + LOG_MARGIN
        self._log = np.full((capacity, 7), 0.0)  # written here, so that the loop meets no first-touch page fault
        self._word = np.zeros(WORDS, dtype=np.int64)
        self._word[SAMPLES] = self.samples.ctypes.data
        self._word[COUNT] = len(self.samples)
        self._word[LOOP] = options.loop
        self._word[LOG] = self._log.ctypes.data
        self._word[CAPACITY] = capacity
        self._word[ARMED] = 1
        self._word.view(np.float64)[PERIOD] = 1.0 / rate_hz
        low, high = self.samples[:, :3].min(axis=0), self.samples[:, :3].max(axis=0)
        self.info = DeviceInfo(
            name=f"replay {Path(options.recording).stem}",
            sensed_dof=6,
            actuated_dof=6,
            force_max_n=FORCE_MAX_N,
            torque_max_nm=TORQUE_MAX_NM,
            stiffness_max_n_per_m=STIFFNESS_MAX_N_PER_M,
            damping_max_ns_per_m=DAMPING_MAX_NS_PER_M,
            workspace_min_m=(float(low[0]), float(low[1]), float(low[2])),
            workspace_max_m=(float(high[0]), float(high[1]), float(high[2])),
            own_clock=True,
        )

    def io(self) -> DeviceIO:
        return DeviceIO(_read.address, _write.address, self._word.ctypes.data)

    def stop(self) -> None:
        while not _silence.ctypes(self._word.ctypes.data):
            time.sleep(0.0001)  # a write holds the lock for some twenty instructions

    def close(self) -> None:
        self.stop()
        path, self._path = self._path, None
        if path is not None:
            self._save(path)

    @property
    def reads(self) -> int:
        """Reads so far."""
        return int(self._word[READS])

    @property
    def lost(self) -> int:
        """Wrenches kept once and overwritten since, because a loop ran longer than the log."""
        return max(0, int(self._word[WRITES]) - len(self._log))

    def written(self) -> Written:
        """The wrenches kept, oldest first. While the servo runs: those that were complete just now."""
        before = int(self._word[WRITES])
        rows = self._log.copy()
        after = int(self._word[WRITES])
        capacity = len(rows)
        # the row after the newest may be half overwritten while it is copied
        first = max(0, (after + 1 if self._word[ARMED] else after) - capacity)
        rows = rows[np.arange(first, before) % capacity] if first < before else rows[:0]
        return Written(rows[:, 0].astype(np.int64), rows[:, 1:].copy())

    def forces(self) -> Array:
        """The wrenches kept (k, 6), oldest first: force N, torque N m in the world frame."""
        return self.written().wrench

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


def open_device(options: Options, rate_hz: float) -> Replay:
    """Open the recording `options.recording` at `rate_hz`; RecordingError when it cannot be used."""
    return Replay(options, rate_hz)


def _forces_path(name: str) -> Path:
    path = Path(name)
    if path.suffix.lower() not in FORCE_ENDINGS:
        raise RecordingError(f"forces = '{name}': must end in {' or '.join(FORCE_ENDINGS)}")
    if not path.parent.is_dir():
        raise RecordingError(f"forces = '{name}': there is no folder {path.parent}: create it first")
    return path
