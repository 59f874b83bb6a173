"""Processes of the daemon killed at random moments: nothing stays, the recording can be read, the next start works.

SOFTFINGER_KILLS says how many; each takes a start of the program, 3 s.
"""

from __future__ import annotations

import os
import random
import subprocess
import sys
import time
from pathlib import Path

import pytest
from emulators.serialboard import Board, Cable
from helpers.serial_devices import PLACE, RIG

from softfinger.config.errors import RecordingError
from softfinger.config.load import find
from softfinger.config.schema import Rig
from softfinger.proxy.record import AT
from softfinger.server.recording.reader import Ticks, contents

pytestmark = [pytest.mark.real_time, pytest.mark.exhaustive]

KILLS = int(os.environ.get("SOFTFINGER_KILLS", "40"))
START_S = 120.0
"""A cold start compiles."""
END_S = 20.0
"""A process that has lost its parent sees it within a second; a busy machine takes more."""
MOMENT_S = 4.0
"""After the start: most of them in its imports, in the opening of the device, or in its first ticks."""


def children(pid: int) -> list[int]:
    try:
        return [int(each) for each in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    except (FileNotFoundError, ProcessLookupError):
        return []


def gone(pid: int) -> bool:
    """Whether a process has ended: a zombie that nobody has waited for has, too."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


def readable(path: Path) -> int:
    """Ticks in a recording, which are one behind the other; none in a file that was cut before its first."""
    try:
        parts = [part.records() for part in contents(path) if isinstance(part, Ticks)]
    except RecordingError:
        assert path.stat().st_size < 4096, "a recording with something in it cannot be read"
        return 0
    ticks = [int(tick) for part in parts for tick in part[:, AT.tick]]
    assert ticks == list(range(len(ticks)))
    return len(ticks)


def command(tmp_path: Path, rig: Path, *words: str) -> list[str]:
    run = [sys.executable, "-m", "softfinger.server.cli", "-q", "run", "--realtime", "off", "--rig", str(rig)]
    return [*run, "--scene", "paper-plane", "--endpoint", f"ipc://{tmp_path}/t", *words]


def start_to_end(tmp_path: Path, rig: Path) -> None:
    """A run that nobody disturbs works."""
    words = command(tmp_path, rig, "--duration", "0.3")
    done = subprocess.run(words, capture_output=True, text=True, timeout=START_S, check=False)
    assert done.returncode == 0, done.stderr


def test_a_kill_at_any_moment_leaves_nothing_behind(tmp_path: Path) -> None:
    """The daemon or its publisher, at random moments from the start of the process on: no process of it is left, the
    recording has whole ticks in a row, and the next daemon gets the same port, socket and folder, to the last, which
    runs to its end."""
    drawn = random.Random(7)
    board = Board(lambda _: (*PLACE[:2], 0.006))
    recorded = 0
    with Cable(board) as cable:
        rig = tmp_path / "rig.toml"
        named = f'driver = "serial"\npath = "{cable.path}"\nquiet_s = 0.1\ntimeout_s = 2.0\n'
        rig.write_text(find(RIG, Rig).read_text().replace('driver = "serial"\n', named))
        start_to_end(tmp_path, rig)  # with its kernels compiled a start comes to its ticks before most kills
        for number in range(KILLS):
            recording = tmp_path / f"{number}.mcap"
            process = subprocess.Popen(
                command(tmp_path, rig, "--record", str(recording)), stderr=subprocess.PIPE, text=True
            )
            try:
                time.sleep(drawn.uniform(0.0, MOMENT_S))
                begun = children(process.pid)
                victim = drawn.choice([process.pid, *begun])
                os.kill(victim, 9)
                if victim != process.pid:  # it starts another, or ends with an error that says so
                    time.sleep(drawn.uniform(0.0, 0.5))
                    begun += children(process.pid)
                    process.kill()
                process.wait()
                until = time.monotonic() + END_S
                while not all(map(gone, begun)):
                    assert time.monotonic() < until, f"kill {number}: a process is left"
                    time.sleep(0.02)
                if recording.exists():
                    recorded += readable(recording)
            finally:
                process.kill()
                process.communicate()
        start_to_end(tmp_path, rig)
    assert recorded > 0, "no kill came after the first tick"
