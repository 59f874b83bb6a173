"""The watcher by itself: what it does once the other end of its pipe has gone. With a daemon: test_signals.py."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
import subprocess
import sys
import termios
import tty
from collections.abc import Iterator

import pytest

from softfinger.server import watcher

ZERO = b"zero\n"
_PR_CAPBSET_DROP, _CAP_SYS_ADMIN = 24, 21


def as_an_ordinary_user() -> None:
    """Of root the right that opens a port which is another's alone."""
    ctypes.CDLL(None).prctl(_PR_CAPBSET_DROP, _CAP_SYS_ADMIN, 0, 0, 0)


@pytest.fixture
def port() -> Iterator[tuple[int, int]]:
    """Both ends of a line, set as the driver sets it: for one opener alone, which goes on as long as this test."""
    far, near = os.openpty()
    tty.setraw(near)
    fcntl.ioctl(near, termios.TIOCEXCL)
    yield far, near
    os.close(near)
    os.close(far)


def watched(name: str, fd: int, told: bytes) -> str:
    """What the watcher of an open device says after the daemon's last words on the pipe."""
    words = [sys.executable, "-I", "-S", watcher.__file__, name, str(fd), ZERO.hex()]
    done = subprocess.run(
        words, input=told, capture_output=True, pass_fds=(fd,), preexec_fn=as_an_ordinary_user, check=True
    )
    return done.stderr.decode()


def test_a_port_that_was_open_for_one_user_alone_takes_the_zero(port: tuple[int, int]) -> None:
    """While somebody else still holds it nobody could open it; afterwards the next daemon can."""
    far, near = port
    name = os.ttyname(near)
    assert watched(name, near, b"") == f"softfinger watcher: the daemon has died: zero force was written to {name}\n"
    assert os.read(far, 100) == watcher.WRITES * ZERO
    opened = [sys.executable, "-c", f"import os; os.open({name!r}, os.O_RDWR | os.O_NOCTTY)"]
    assert subprocess.run(opened, preexec_fn=as_an_ordinary_user, check=False).returncode == 0


def test_a_device_that_was_closed_in_order_is_left_alone(port: tuple[int, int]) -> None:
    """Nothing is written, and nothing said."""
    far, near = port
    os.set_blocking(far, False)
    assert watched(os.ttyname(near), near, watcher.CLOSED) == ""
    with pytest.raises(BlockingIOError):
        os.read(far, 100)


def test_what_cannot_be_written_is_said() -> None:
    """A device that has gone meanwhile."""
    far, near = os.openpty()
    name = os.ttyname(near)
    os.close(far)
    said = watched(name, near, b"")
    os.close(near)
    why = f"zero force could not be written to {name}: {os.strerror(errno.EIO)}"
    assert said == f"softfinger watcher: the daemon has died: {why}\n"
