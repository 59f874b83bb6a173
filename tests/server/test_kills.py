"""Processes of a run killed at random moments: nothing stays, the recording can be read, the next start works.

SOFTFINGER_KILLS says how many `make test-all` makes; each takes a start of the program with its page, 4 s.
"""

from __future__ import annotations

import itertools
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from emulators.serialboard import Board, Cable
from helpers.programs import Program
from helpers.serial_devices import PLACE, RIG

from softfinger.config.errors import RecordingError
from softfinger.config.schema import Rig
from softfinger.config.sources import find
from softfinger.proxy.record import AT
from softfinger.server.recording.reader import Ticks, read_contents

pytestmark = pytest.mark.real_time

KILLS = int(os.environ.get("SOFTFINGER_KILLS", "40"))
VICTIMS = {
    "page": b"\0view\0",
    "telemetry process": b"\0softfinger.server.publishing\0telemetry\0",
    "commands process": b"\0softfinger.server.publishing\0commands\0",
    "daemon": b"\0run\0",
}
"""What the command of each has in it."""
START_S = 120.0
"""A cold start compiles."""
END_S = 20.0
"""A process that has lost its parent sees it within a second; a busy machine takes more."""
MOMENT_S = 4.0
"""After the start: most of them in its imports, in the opening of the device, or in its first ticks."""


def children(pid: int) -> list[int]:
    """Of all of its threads: what is started again is started by whoever looks after it."""
    found: list[int] = []
    for thread in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(FileNotFoundError, ProcessLookupError):
            found += map(int, thread.read_text().split())
    return found


def of_kind(kind: str, pid: int) -> int | None:
    """Return the process of a run with this role, if it has started."""
    for each in (pid, *children(pid)):
        with suppress(FileNotFoundError, ProcessLookupError):
            if VICTIMS[kind] in Path(f"/proc/{each}/cmdline").read_bytes():
                return each
    return None


def until(what: Callable[[], object], said: str, seconds: float) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < end, said
        time.sleep(0.02)


def gone(pid: int) -> bool:
    """Whether a process has ended: a zombie that nobody has waited for has, too."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


def readable(path: Path) -> int:
    """Ticks in a recording, which are one behind the other; none in a file that was cut before its first."""
    try:
        parts = [part.records() for part in read_contents(path) if isinstance(part, Ticks)]
    except RecordingError:
        assert path.stat().st_size < 4096, "a recording with something in it cannot be read"
        return 0
    ticks = [int(tick) for part in parts for tick in part[:, AT.tick]]
    assert ticks == list(range(len(ticks)))
    return len(ticks)


def command(tmp_path: Path, rig: Path, *words: str) -> list[str]:
    run = [sys.executable, "-m", "softfinger.server.cli", "-q", "run", "--realtime", "off", "--rig", str(rig), "--view"]
    return [*run, "--scene", "paper-plane", "--endpoint", f"ipc://{tmp_path}/t", *words]


def start_to_end(tmp_path: Path, rig: Path) -> None:
    """A run that nobody disturbs works, and leaves no socket, not even one of a run that was killed before."""
    words = command(tmp_path, rig, "--duration", "0.3")
    done = subprocess.run(words, capture_output=True, text=True, timeout=START_S, check=False)
    assert done.returncode == 0, done.stderr
    assert not [path for path in tmp_path.iterdir() if path.is_socket()]


def kill(process: subprocess.Popen[bytes], kind: str, told: Path) -> list[int]:
    """Kill one of the processes of a run, once it is there; of a page or a publisher wait until it is told that it has
    ended. Returns all processes that the daemon had then."""
    until(lambda: of_kind(kind, process.pid) or process.poll() is not None, f"there is no {kind}", START_S)
    begun, victim = children(process.pid), of_kind(kind, process.pid)
    assert victim is not None, told.read_text()
    os.kill(victim, signal.SIGKILL)
    if kind != "daemon":
        words = f"the {kind} has ended"
        until(lambda: words in told.read_text() or process.poll() is not None, f"{words}: not told", START_S)
        assert words in told.read_text()
    return begun + children(process.pid)


@pytest.mark.exhaustive
@pytest.mark.parametrize("kills", [len(VICTIMS), KILLS])
def test_a_kill_at_any_moment_leaves_nothing_behind(kills: int, tmp_path: Path) -> None:
    """All processes of a run by turns, at random moments: the end of one is reported. Then the daemon: no process of it
    is left, the recording has whole ticks in a row, and the next one gets the same port, socket and folder, to the
    last, which runs to its end and leaves no socket."""
    drawn = random.Random(7)
    board = Board(lambda _: (*PLACE[:2], 0.006))
    recorded = 0
    with Cable(board) as cable:
        rig = tmp_path / "rig.toml"
        named = f'driver = "serial"\npath = "{cable.path}"\nquiet_s = 0.1\ntimeout_s = 2.0\n'
        rig.write_text(find(RIG, Rig).read_text().replace('driver = "serial"\n', named))
        start_to_end(tmp_path, rig)  # with its kernels compiled a start comes to its ticks before most kills
        for number, kind in zip(range(kills), itertools.cycle(VICTIMS)):
            recording, told = tmp_path / f"{number}.mcap", tmp_path / f"{number}.log"
            with told.open("wb") as log, Program(
                command(tmp_path, rig, "--record", str(recording)), stderr=log
            ) as process:  # fmt: skip
                try:
                    time.sleep(drawn.uniform(0.0, MOMENT_S))
                    begun = kill(process, kind, told)
                    time.sleep(drawn.uniform(0.0, 0.5))  # it starts another, or ends with an error that says so
                    begun += children(process.pid)
                finally:
                    process.kill()
            until(lambda begun=begun: all(map(gone, begun)), f"kill {number}: a process is left", END_S)
            if recording.exists():
                recorded += readable(recording)
        start_to_end(tmp_path, rig)
    assert recorded > 0 or kills == len(VICTIMS), "no kill came after the first tick"
