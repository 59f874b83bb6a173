"""Hapkit behind a pseudo terminal, in real time: the shipped sketch, compiled with `stubs/arduino/hapkit.cpp`."""

import ctypes
import shutil
import subprocess
import tty
from pathlib import Path

from emulators.farterminal import Terminal

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


class Hapkit(Terminal):
    """The board; all boards of a library share the variables of the sketch, so that only one may run."""

    def __init__(self, library: Path) -> None:
        super().__init__()
        self._code = ctypes.CDLL(str(library))
        self._code.board_torque.restype = ctypes.c_double
        self._code.board_turn.argtypes = [ctypes.c_double]
        tty.setraw(self._near)
        self.turn(0.0)
        self._code.board_start(self._far)
        self._thread.start()

    def _run(self) -> None:
        self._code.board_run()

    def turn(self, joint_rad: float) -> None:
        motor = joint_rad * SECTOR_M / PULLEY_M
        self._code.board_turn(motor / 3.141592653589793 * COUNTS_PER_HALF_TURN)

    def hush(self) -> None:
        self._code.board_mute(1)

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

    def pull(self) -> None:
        if not self.pulled:
            self._code.board_stop()
        super().pull()
