"""Serial board in a separate process whose position is the time, to measure ages of poses and forces.

x (m) is the fraction of the second (monotonic clock) at which a frame was made; each force is logged with the time at
which its frame was complete. Not modelled: the transfer time of a line, and a USB adapter's buffer.
"""

from __future__ import annotations

import multiprocessing
import os
import select
import struct
import time
import tty
from pathlib import Path
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from emulators.guideboard import crc8

FRAME: Final = struct.Struct("<B3fB")
BYTES: Final = FRAME.size
"""Bytes of a frame in either direction: a mark, three numbers of four bytes, checksum."""
PERIOD_S: Final = 0.001


def device_table(path: str, mode: str) -> dict[str, Any]:
    check = {"kind": "crc8", "offset": BYTES - 1}
    offsets = list(zip("xyz", (1, 5, 9), strict=True))
    position = [{"meaning": axis, "offset": at, "type": "int32", "scale": 1e-9} for axis, at in offsets]
    force = [{"meaning": f"force_{axis}", "offset": at, "type": "float32"} for axis, at in offsets]
    return {
        "path": path, "force_max_n": 3.0, "stiffness_max_n_per_m": 300.0, "damping_max_ns_per_m": 1.0,
        "workspace_radius_m": 1.0, "quiet_s": 0.1, "timeout_s": 0.5, "kinematics": {"kind": "cartesian"},
        "frames": {
            "mode": mode,
            "input": {"bytes": BYTES, "start": [0xA5], "check": check, "field": position},
            "output": {"bytes": BYTES, "start": [0x5A], "check": check, "field": force},
        },
    }  # fmt: skip


class ClockBoard:
    """Board at the far end of a pseudo terminal: it answers each frame, or sends one per millisecond (`stream`)."""

    def __init__(self, mode: str, log: Path) -> None:
        self._log = log
        far, self._near = os.openpty()
        tty.setraw(self._near)
        self.options = device_table(os.ttyname(self._near), mode)
        self._process = multiprocessing.get_context("fork").Process(target=_run, args=(far, mode, log), daemon=True)
        self._process.start()
        os.close(far)

    def received_forces(self) -> NDArray[np.float64]:
        """Return time (s, monotonic clock) and force along z (N) of every frame so far, shape (n, 2)."""
        data = self._log.read_bytes()
        return np.frombuffer(data[: len(data) // 16 * 16]).reshape(-1, 2)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.join()
        os.close(self._near)


def _run(far: int, mode: str, log: Path) -> None:
    rest, due = b"", time.monotonic()
    with log.open("wb", buffering=0) as out:
        while True:
            remaining = max(0.0, due - time.monotonic()) if mode == "stream" else None
            if select.select([far], [], [], remaining)[0]:
                rest += os.read(far, 4096)
                while len(rest) >= BYTES:
                    mark, _, _, force, check = FRAME.unpack_from(rest)
                    if mark != 0x5A or crc8(rest[: BYTES - 1]) != check:
                        rest = rest[1:]
                        continue
                    out.write(struct.pack("<dd", time.monotonic(), force))
                    rest = rest[BYTES:]
                    if mode == "answer":
                        _send(far)
            if mode == "stream" and time.monotonic() >= due:
                _send(far)
                due = max(due + PERIOD_S, time.monotonic())


def _send(far: int) -> None:
    frame = struct.pack("<B3i", 0xA5, time.monotonic_ns() % 1_000_000_000, 0, 0)
    os.write(far, frame + bytes([crc8(frame)]))
