"""Recording as a device: reads return recorded poses, and every written wrench is logged.

Read number n returns sample n regardless of the clock, so that a run is reproducible to the bit.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Final, NamedTuple

import msgspec
import numpy as np

from softfinger.config.arrays import Array
from softfinger.config.errors import ConfigError
from softfinger.config.files import is_same_file
from softfinger.config.schema import doc
from softfinger.drivers import wrench_log
from softfinger.drivers.base import END, OK, SAMPLE_BUTTONS, SAMPLE_GRIPPER, SAMPLE_TIME, make_unlimited_info
from softfinger.drivers.block import Block, address, lay_out, numbers, word
from softfinger.drivers.poses import load_poses
from softfinger.drivers.resample import close_loop, resample
from softfinger.drivers.system.libc import IO_SIGNATURE
from softfinger.drivers.wrench_log import LOG, LoggedDevice
from softfinger.proxy.kernels.jit.decorators import c_function
from softfinger.proxy.kernels.jit.memory import float64_at, int64_at


class Fields(NamedTuple):
    """Fields of a replay, after the fields of the log."""

    samples: Annotated[int, address("(length, 7) float64")]
    length: Annotated[int, word("of the recording")]
    loop: Annotated[int, word("restart the recording at its end")]
    next_sample: Annotated[int, word("wrapped by comparison, which is cheaper than a remainder")]
    period: Annotated[int, numbers("s", 1)]


AT: Final = lay_out(Fields, after=LOG)


class Options(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Keys of a rig's [device] with `driver = "replay"`."""

    recording: Annotated[str, doc("file (.csv, .npz, .mcap) or name of a shipped recording", "press-roll-spin-drag")]
    finger: Annotated[str, doc("finger of a recording of several fingers; empty: a single one", "thumb")] = ""
    loop: Annotated[bool, doc("start again at the end, over a smooth return; false: stop after one pass")] = True
    forces: Annotated[str | None, doc("file (.csv or .npz) for the wrenches written, saved on close")] = None


@c_function(IO_SIGNATURE)
def _read(handle: int, sample: Any) -> int:
    at = int64_at(handle)
    n = at[LOG.reads]
    at[LOG.reads] = n + 1
    status = OK
    index = at[AT.next_sample]
    if index < at[AT.length]:
        at[AT.next_sample] = index + 1
    elif at[AT.loop]:
        index = 0
        at[AT.next_sample] = 1
    else:
        n = index = at[AT.length] - 1
        status = END
    pose = float64_at(at[AT.samples] + index * 56)
    for k in range(7):
        sample[k] = pose[k]
    sample[SAMPLE_TIME] = n * float64_at(handle)[AT.period]
    sample[SAMPLE_BUTTONS] = sample[SAMPLE_GRIPPER] = 0.0
    return status


class Replay(LoggedDevice):
    """Recording at the servo's rate; `forces` returns the logged wrenches.

    Without `loop` the log contains the wrenches of the full pass; with it, at least the last pass and the last 10 s.
    After `stop` the device remains disarmed, and the last logged wrench is zero.
    """

    _functions = _read, wrench_log.write

    def __init__(self, options: Options, rate_hz: float) -> None:
        if options.forces is not None and is_same_file(options.recording, options.forces):
            raise ConfigError(f"forces = {options.forces!r}: is the replayed recording: choose another output file")
        samples = resample(load_poses(options.recording, options.finger), rate_hz)
        self.samples: Array = np.ascontiguousarray(close_loop(samples, rate_hz) if options.loop else samples)
        """Poses (M, 7) that reads return in order."""
        block = Block(LOG, AT)
        super().__init__(block, len(self.samples), rate_hz, options.forces)
        block.set_address(AT.samples, self.samples)
        block.word[AT.length], block.word[AT.loop] = len(self.samples), options.loop
        block.numbers(AT.period, 1)[:] = 1.0 / rate_hz
        low, high = self.samples[:, :3].min(axis=0), self.samples[:, :3].max(axis=0)
        self.info = make_unlimited_info(f"replay {Path(options.recording).stem}", 6, low, high, own_clock=True)

    @property
    def reads(self) -> int:
        """Number of reads."""
        return int(self._block.word[LOG.reads])

    def forces(self) -> Array:
        """Return the logged wrenches (k, 6), oldest first: force N, torque N m in the world frame."""
        return self.read_log().wrench


def open_device(options: Options, rate_hz: float) -> Replay:
    """Open the recording `options.recording` at `rate_hz`; raises RecordingError if it cannot be used."""
    return Replay(options, rate_hz)
