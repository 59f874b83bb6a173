"""Processes of a run killed at random times: no process is left, the recording is readable, and the next start works.

SOFTFINGER_KILLS is the number of kills for `make test-all`; each needs a start of the program with its page, 4 s.
"""

from __future__ import annotations

import itertools
import os
import random
import signal
import subprocess
import time
from pathlib import Path

import pytest
from emulators.serialboard import Board, Cable
from helpers.processes import COMMAND, list_children, read_command_line
from helpers.programs import Program, run_program
from helpers.rig_files import write_rig
from helpers.serial_devices import PLACE, RIG
from helpers.waits import until

from softfinger.config.errors import RecordingError
from softfinger.proxy.record import AT
from softfinger.server.recording.reader import TickBlock, read_contents

pytestmark = pytest.mark.real_time

KILLS = int(os.environ.get("SOFTFINGER_KILLS", "40"))
VICTIMS = {
    "page": b"\0view\0",
    "telemetry process": b"\0softfinger.server.socket_process\0telemetry\0",
    "commands process": b"\0softfinger.server.socket_process\0commands\0",
    "daemon": b"\0run\0",
}
"""Part of the command line of each process."""
START_S = 120.0
"""A cold start compiles."""
END_S = 20.0
"""A process notices the end of its parent within 1 s; a busy machine takes longer."""
MOMENT_S = 4.0
"""Latest time of a kill after the start: most hit the imports, the opening of the device, or the first ticks."""


def find_process(kind: str, pid: int) -> int | None:
    """Return the process of a run with this role, if it has started."""
    return next((victim for victim in (pid, *list_children(pid)) if VICTIMS[kind] in read_command_line(victim)), None)


def has_exited(pid: int) -> bool:
    """Return True if a process has exited, also as a zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


def count_readable(path: Path) -> int:
    """Return the number of consecutive ticks in a recording; 0 for a file that ends before its first tick."""
    try:
        parts = [part.records() for part in read_contents(path) if isinstance(part, TickBlock)]
    except RecordingError:
        assert path.stat().st_size < 4096, "a recording with something in it cannot be read"
        return 0
    ticks = [int(tick) for part in parts for tick in part[:, AT.tick]]
    assert ticks == list(range(len(ticks)))
    return len(ticks)


def make_command(tmp_path: Path, rig: Path, *words: str) -> list[str]:
    run = [*COMMAND, "-q", "run", "--realtime", "off", "--rig", str(rig), "--view"]
    return [*run, "--scene", "paper-plane", "--endpoint", f"ipc://{tmp_path}/t", *words]


def run_to_end(tmp_path: Path, rig: Path) -> None:
    """An undisturbed run exits with 0 and leaves no socket, not even one of a previous killed run."""
    words = make_command(tmp_path, rig, "--duration", "0.3")
    completed = run_program(words, timeout=START_S)
    assert completed.returncode == 0, completed.stderr
    assert not [path for path in tmp_path.iterdir() if path.is_socket()]


def kill(process: subprocess.Popen[bytes], kind: str, log_path: Path) -> list[int]:
    """Kill one process of a run, wait until its end is reported, and return all that the daemon had."""
    until(lambda: find_process(kind, process.pid) or process.poll() is not None, START_S, f"there is no {kind}")
    started_pids, victim = list_children(process.pid), find_process(kind, process.pid)
    assert victim is not None, log_path.read_text()
    os.kill(victim, signal.SIGKILL)
    if kind != "daemon":
        words = f"the {kind} has ended"
        until(lambda: words in log_path.read_text() or process.poll() is not None, START_S, f"{words}: not told")
        assert words in log_path.read_text()
    return started_pids + list_children(process.pid)


@pytest.mark.exhaustive
def test_a_kill_at_any_time_leaves_no_process(tmp_path: Path) -> None:
    drawn = random.Random(7)
    board = Board(lambda _: (*PLACE[:2], 0.006))
    recorded = 0
    with Cable(board) as cable:
        rig = write_rig(tmp_path, RIG, path=cable.path, quiet_s=0.1, timeout_s=2.0)
        run_to_end(tmp_path, rig)  # with compiled kernels a run reaches its ticks before most kills
        for number, kind in zip(range(KILLS), itertools.cycle(VICTIMS)):
            recording, log_path = tmp_path / f"{number}.mcap", tmp_path / f"{number}.log"
            with log_path.open("wb") as log, Program(
                make_command(tmp_path, rig, "--record", str(recording)), stderr=log
            ) as process:  # fmt: skip
                try:
                    time.sleep(drawn.uniform(0.0, MOMENT_S))
                    pids = kill(process, kind, log_path)
                    time.sleep(drawn.uniform(0.0, 0.5))  # the daemon restarts the process, or ends with an error
                    pids += list_children(process.pid)
                finally:
                    process.kill()
            until(lambda pids=pids: all(map(has_exited, pids)), END_S, f"kill {number}: a process is left")
            if recording.exists():
                recorded += count_readable(recording)
        run_to_end(tmp_path, rig)
    assert recorded > 0 or len(VICTIMS) >= KILLS, "no kill came after the first tick"
