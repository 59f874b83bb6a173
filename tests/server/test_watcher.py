"""The watcher after its pipe closes. test_signals.py tests it with a daemon."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import signal
import struct
import subprocess
import sys
import termios
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers.waits import ends_within

from softfinger.server import watcher

ZERO = b"zero\n"
_PR_CAPBSET_DROP, _CAP_SYS_ADMIN = 24, 21


def as_an_ordinary_user() -> None:
    ctypes.CDLL(None).prctl(_PR_CAPBSET_DROP, _CAP_SYS_ADMIN, 0, 0, 0)


@pytest.fixture
def port() -> Iterator[tuple[int, int]]:
    far, near = os.openpty()
    tty.setraw(near)
    fcntl.ioctl(near, termios.TIOCEXCL)
    yield far, near
    os.close(near)
    os.close(far)


def watch(name: str, fd: int, stdin: bytes) -> str:
    words = [sys.executable, "-I", "-S", watcher.__file__, name, str(fd), ZERO.hex()]
    process = subprocess.run(
        words, input=stdin, capture_output=True, pass_fds=(fd,), preexec_fn=as_an_ordinary_user, check=True
    )
    return process.stderr.decode()


def test_an_exclusively_open_port_gets_the_zero(port: tuple[int, int]) -> None:
    far, near = port
    name = os.ttyname(near)
    fcntl.ioctl(far, termios.TIOCPKT, struct.pack("i", 1))  # each read has a byte of status
    assert watch(name, near, b"") == f"softfinger watcher: the daemon has died: zero force was written to {name}\n"
    assert os.read(far, 100)[0] & termios.TIOCPKT_FLUSHWRITE
    received = b""
    while len(received) < watcher.ZERO_WRITES * len(ZERO):  # one read may return fewer writes
        status, *data = os.read(far, 100)
        assert status == termios.TIOCPKT_DATA
        received += bytes(data)
    assert received == watcher.ZERO_WRITES * ZERO
    opened = [sys.executable, "-c", f"import os; os.open({name!r}, os.O_RDWR | os.O_NOCTTY)"]
    assert subprocess.run(opened, preexec_fn=as_an_ordinary_user, check=False).returncode == 0


def test_a_device_that_was_closed_is_not_written_to(port: tuple[int, int]) -> None:
    far, near = port
    os.set_blocking(far, False)
    assert watch(os.ttyname(near), near, watcher.CLOSED_MESSAGE) == ""
    with pytest.raises(BlockingIOError):
        os.read(far, 100)


def test_a_failed_zero_is_reported() -> None:
    far, near = os.openpty()
    name = os.ttyname(near)
    os.close(far)
    stderr = watch(name, near, b"")
    os.close(near)
    why = f"zero force could not be written to {name}: {os.strerror(errno.EIO)}"
    assert stderr == f"softfinger watcher: the daemon has died: {why}\n"


def test_a_stopped_watcher_does_not_delay_the_end(port: tuple[int, int]) -> None:
    _, near = port
    watching = watcher.Watcher(os.ttyname(near), near, ZERO)
    pid = watching._process.pid
    os.kill(pid, signal.SIGSTOP)
    with ends_within(60):
        watching.dismiss()
    assert not Path(f"/proc/{pid}").exists()


def test_a_watcher_that_ends_repeatedly_is_reported_once(port: tuple[int, int]) -> None:
    _, near = port
    watching = watcher.Watcher(os.ttyname(near), near, ZERO)
    reports = [watching.supervise()]
    for _ in range(watcher.RESTARTS + 1):
        watching._process.kill()
        watching._process.wait()
        reports.append(watching.supervise())
    reports.append(watching.supervise())
    watching.dismiss()
    assert [report.rpartition("(-9) and ")[2].partition(":")[0] for report in reports] == [
        "",
        *["was restarted"] * watcher.RESTARTS,
        "is not restarted",
        "",
    ]
