"""Ticks in shared memory: readers in Python and C, slow and killed readers, and files of a killed daemon."""

import gc
import os
import re
import secrets
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.daemons import make_daemon
from helpers.programs import Program
from helpers.shortages import refuse_threads
from helpers.telemetry_records import synthetic

from softfinger.config.errors import ConfigError
from softfinger.proxy.record import AT, RECORD_SIZE, list_columns
from softfinger.server.wire.control import Control
from softfinger.server.wire.native import memory
from softfinger.server.wire.native.memory import Local, make_memory, remove
from softfinger.server.wire.native.relay import CAPACITY_TICKS
from softfinger.server.wire.publisher import Publisher

pytestmark = pytest.mark.real_time

WAIT_S = 60.0
PAGE = (Path(__file__).parents[2] / "docs" / "protocol.md").read_text(encoding="utf-8")
INCLUDE = Path(memory.__file__).parent

READER = """
#include "softfinger_ring.h"
#include <stdlib.h>

int main(int argc, char **argv)
{
    struct softfinger_ring ring;
    if (softfinger_open(&ring, argv[1])) return 1;
    double *row = malloc(ring.width * sizeof *row);
    long rows = 0, wrong = 0;
    double before = -1.0;
    puts("open"), fflush(stdout);
    if (argc > 2) getchar(); /* a reader that is slow */
    while (softfinger_wait(&ring, 1000))
        while (softfinger_read(&ring, row)) {
            double tick = row[TICK];
            wrong += rows && tick != before + 1 && !ring.lost;
            wrong += row[LAST] != tick * 0.5; /* a row that is torn */
            before = tick, rows++;
        }
    printf("%ld %ld %ld %.0f\\n", rows, (long)ring.lost, wrong, before);
    softfinger_close(&ring);
    return 0;
}
"""


@pytest.fixture(scope="module")
def program(tmp_path_factory):
    """Compile the C reader with the shipped header and without warnings."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("no C compiler")
    folder = tmp_path_factory.mktemp("ring")
    (folder / "reader.c").write_text(READER)
    words = [compiler, "-O2", "-Wall", "-Wextra", "-Werror", f"-DTICK={AT.tick}", f"-DLAST={RECORD_SIZE - 1}"]
    subprocess.run([*words, f"-I{INCLUDE}", "-o", "reader", "reader.c"], cwd=folder, check=True)
    return str(folder / "reader")


def make_numbered(count, first=0):
    """Return ticks; the last column shows if a row is complete."""
    records = synthetic(count, first)
    records[:, -1] = 0.5 * records[:, AT.tick]
    return records


def open_reader(program, name, *more):
    process = subprocess.Popen([program, name, *more], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "open\n"
    return process


def test_readers_in_c_get_every_tick_and_count_gaps(program):
    count = 2 * CAPACITY_TICKS
    with Publisher("tcp://127.0.0.1:*") as publisher:
        name = publisher.ring()["name"]
        assert (memory.FOLDER / name).stat().st_mode & 0o777 == 0o600
        slow, killed, stopped = (open_reader(program, name, "slow") for _ in range(3))
        stopped.send_signal(signal.SIGSTOP)
        with Local(name) as witness:
            reading = open_reader(program, name)
            for at in range(0, count, 1000):
                publisher.publish(make_numbered(min(1000, count - at), at))
                if at == 3000:
                    killed.kill()
                rows = 0
                while rows < min(1000, count - at):  # publish only as fast as this reader reads
                    rows += len(witness.take(WAIT_S))
            assert witness.lost == 0
            slow.stdin.write("\n")
            slow.stdin.flush()
    output, _ = reading.communicate(timeout=WAIT_S)
    rows, lost, wrong, last = map(int, output.split())
    assert (rows + lost, wrong, last) == (count, 0, count - 1)
    output, _ = slow.communicate(timeout=WAIT_S)
    assert list(map(int, output.split())) == [CAPACITY_TICKS // 2, count - CAPACITY_TICKS // 2, 0, count - 1]
    killed.communicate()
    stopped.kill()
    stopped.communicate()


def test_describe_returns_the_ring_of_ticks():
    batches = []
    with make_daemon(500) as daemon:
        ring = daemon.publisher.ring()
        with Local(ring["name"]) as ticks:
            daemon.start()
            with Control(daemon.commands_endpoint) as control:
                assert control.describe()["ring"] == ring
            daemon.wait(WAIT_S)
            daemon.close()
            assert not (memory.FOLDER / ring["name"]).exists()
            while len(rows := ticks.take(WAIT_S)):
                batches.append(rows.copy())
            assert ticks.ended and ticks.lost == 0
    records = np.concatenate(batches)
    assert ring["columns"] == list_columns() and records.shape == (500, ring["records_in_a_row"] * RECORD_SIZE)
    assert records[:, AT.tick].tolist() == list(range(500))


def test_program_on_the_page_runs():
    (program,) = [fence for fence in re.findall(r"```python\n(.*?)```", PAGE, re.DOTALL) if "Local" in fence]
    with make_daemon() as daemon:
        code = program.replace("Control()", f"Control({daemon.commands_endpoint!r})")
        daemon.start()
        process = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
        rows, _, lost = process.stdout.readline().split()
        assert int(rows) > 0 and lost == "0"
    process.communicate(timeout=WAIT_S)
    assert process.returncode == 0


SLEEPING = """
import sys
from softfinger.server.wire.native.memory import Local
ticks = Local(sys.argv[1])
print('open', flush=True)
while len(rows := ticks.take(1e6)):  # longer than the test
    print(rows.tolist(), flush=True)
"""


def test_a_sleeping_reader_wakes_at_a_tick_and_at_the_end():
    shared = make_memory(16, 4)
    with Program([sys.executable, "-c", SLEEPING, shared.name], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "open\n"
        shared.broadcast.slots[0] = 7.0
        shared.broadcast.head[0] = 1
        memory.wake_readers(shared.broadcast)
        assert process.stdout.readline() == "[[7.0, 7.0, 7.0, 7.0]]\n"
        remove(shared)
        assert process.wait(WAIT_S) == 0


KILLED = """
import sys, time
from softfinger.server.wire.native.memory import make_memory
print(make_memory(16, 4).name, flush=True)
time.sleep(1000)
"""


def test_files_of_a_killed_daemon_are_removed():
    living = make_memory(16, 4)
    with Program([sys.executable, "-c", KILLED], stdout=subprocess.PIPE, text=True) as process:
        name = process.stdout.readline().strip()
        with Local(name) as ticks:
            assert not ticks.ended
            process.kill()
            process.wait()
            assert len(ticks.take(WAIT_S)) == 0 and ticks.ended
    abandoned = memory.FOLDER / name
    assert abandoned.exists()
    second = make_memory(16, 4)
    assert not abandoned.exists() and (memory.FOLDER / living.name).exists()
    for shared in (living, second):
        remove(shared)
        assert not (memory.FOLDER / shared.name).exists()


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to give files away")
def test_files_of_another_user_are_not_removed():
    theirs, own = (memory.FOLDER / f"{memory.PREFIX}{secrets.token_hex(8)}" for _ in range(2))
    try:
        for path in (theirs, own):
            path.touch(0o600)
        os.chown(theirs, 65534, 65534)
        memory.remove_stale_files()
        assert theirs.exists() and not own.exists()
    finally:
        theirs.unlink()


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("../etc/passwd", "see softfinger ctl describe"),
        ("softfinger-none", "check that the daemon is running"),
        ("softfinger-empty", "cannot be read"),
        ("softfinger-other", "layout 1"),
    ],
)
def test_unreadable_rings_are_refused(name, message, tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "FOLDER", tmp_path)
    (tmp_path / "softfinger-empty").touch()
    (tmp_path / "softfinger-other").write_bytes(bytes(8192))
    with pytest.raises(ConfigError, match=message):
        Local(name)


def test_the_daemon_runs_without_shared_memory(tmp_path, monkeypatch, caplog):
    monkeypatch.setattr(memory, "FOLDER", tmp_path / "none")
    with Publisher("tcp://127.0.0.1:*") as publisher:
        assert publisher.ring()["name"] == ""
        publisher.publish(synthetic(10))
        out = np.empty((16, RECORD_SIZE))
        assert publisher.tap.take(out) == 10
    assert "local readers" in caplog.text


def test_a_relay_that_cannot_start_leaves_no_file(tmp_path, monkeypatch):
    monkeypatch.setattr(memory, "FOLDER", tmp_path)
    refuse_threads(monkeypatch)
    gc.collect()
    before = set(os.listdir("/proc/self/fd"))
    with pytest.raises(RuntimeError):
        Publisher("tcp://127.0.0.1:*")
    gc.collect()
    assert set(os.listdir("/proc/self/fd")) <= before and not any(tmp_path.iterdir())
