"""Hapkit behind a pseudo terminal, in real time: the shipped sketch, compiled with `stubs/arduino/hapkit.cpp`."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
import threading
import tty
from pathlib import Path
from typing import Self

STUB = Path(__file__).parents[1] / "stubs" / "arduino" / "hapkit.cpp"
SKETCH = Path(__file__).parents[2] / "examples" / "hapkit" / "hapkit.ino"
COMPILER = next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))), None)
NO_COMPILER = "the Hapkit's sketch is C++, and there is no compiler (c++, g++, clang++) to build it"

PULLEY_M, SECTOR_M, HANDLE_M = 0.005, 0.074, 0.09
COUNTS_PER_HALF_TURN = 980.0


def compile_sketch(path: Path) -> Path:
    flags = ["-O2", "-Wall", "-Wextra", "-Werror", "-shared", "-fPIC", f'-DSKETCH="{SKETCH}"']
    subprocess.run([str(COMPILER), *flags, "-o", str(path), str(STUB)], check=True)
    return path


class Hapkit:
    def __init__(self, library: Path) -> None:
        self._code = ctypes.CDLL(str(library))
        self._code.board_torque.restype = ctypes.c_double
        self._code.board_turn.argtypes = [ctypes.c_double]
        self._far, self._near = os.openpty()
        tty.setraw(self._near)
        os.set_blocking(self._far, False)
        self.path = os.ttyname(self._near)
        self.pulled = False
        self.turn(0.0)
        self._code.board_start(self._far)
        self._thread = threading.Thread(target=self._code.board_run, daemon=True)
        self._thread.start()

    def turn(self, joint_rad: float) -> None:
        motor = joint_rad * SECTOR_M / PULLEY_M
        self._code.board_turn(motor / 3.141592653589793 * COUNTS_PER_HALF_TURN)

    def mute(self, yes: bool = True) -> None:
        self._code.board_mute(int(yes))

    def torque(self) -> float:
        return 0.0 if self.pulled else float(self._code.board_torque()) * SECTOR_M / PULLEY_M

    def changes(self) -> list[tuple[float, float]]:
        """Return time (s, monotonic clock) and torque at the motor (N m) of every change."""
        out = (ctypes.c_double * (2 << 16))()
        count = self._code.board_changes(out, 1 << 16)
        return [(out[2 * k], out[2 * k + 1]) for k in range(count)]

    def processed(self) -> int:
        """Return how many bytes of the host the sketch has processed."""
        return int(self._code.board_processed())

    def say(self, data: bytes) -> bool:
        """Send bytes to the host; return False if the terminal has no room for them, because nobody reads it."""
        try:
            return os.write(self._far, data) == len(data)
        except BlockingIOError:
            return False

    def pull(self) -> None:
        if not self.pulled:
            self.pulled = True
            self._code.board_stop()
            self._thread.join()
            os.close(self._near)
            os.close(self._far)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.pull()
