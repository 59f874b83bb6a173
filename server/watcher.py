"""The watcher: a process beside the daemon that takes the force off a device whose daemon was killed.

It waits for the end of a pipe that the daemon holds, and no more: it takes no part in anything before. When the daemon
has closed its device it says so on the pipe, and the watcher goes. Else the daemon has died, SIGKILL or a fault in a
library: then the watcher writes the zero that it was given to the device, whose descriptor it has from the daemon. It
could not always open the node: a serial port that was open for one user alone is so until the last who holds it has
closed it.

This file is run by itself, without this package, so that the process is small and needs no compiler.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import signal
import subprocess
import sys
import termios
import time

CLOSED = b"closed"
WRITES = 3
"""The first zero may come behind the half of a frame that the daemon began."""
PAUSE_S = 0.005
TRY_S = 2.0
"""How long a device may take no bytes."""


class Watcher:
    """Starts the process; `dismiss` once the device is closed.

    node  path of the device's node
    fd    the open device
    zero  what commands zero when it is written there
    """

    def __init__(self, node: str, fd: int, zero: bytes) -> None:
        words = [sys.executable, "-I", "-S", __file__, node, str(fd), zero.hex()]
        # A session of its own: Ctrl-C and the end of a terminal are for the daemon.
        self._process = subprocess.Popen(words, stdin=subprocess.PIPE, pass_fds=(fd,), start_new_session=True)

    def dismiss(self) -> None:
        """The device is closed: the process is not needed any more."""
        self._process.communicate(CLOSED)


def take_force_off(node: str, fd: int, zero: bytes) -> str:
    """Drop what waits in a device's port and write the zero to it; what came of it in words."""
    until, done, said = time.monotonic() + TRY_S, 0, "it took a part of it"
    with contextlib.suppress(OSError, termios.error):  # no serial port, or gone
        termios.tcflush(fd, termios.TCOFLUSH)
    while done < WRITES and time.monotonic() < until:
        try:
            done += os.write(fd, zero) == len(zero)
        except OSError as error:
            said = error.strerror or str(error)
        time.sleep(PAUSE_S)
    while done and _unsent(fd) and time.monotonic() < until:
        time.sleep(PAUSE_S)
    waits = f", but {count} bytes of it wait in the port: switch the device off" if (count := _unsent(fd)) else ""
    with contextlib.suppress(OSError):  # no serial port, or gone
        fcntl.ioctl(fd, termios.TIOCNXCL)  # as a daemon that closes it does: the next one may have another user
    return f"zero force was written to {node}{waits}" if done else f"zero force could not be written to {node}: {said}"


def _unsent(fd: int) -> int:
    """Bytes that wait in a serial port; 0 for what is none."""
    with contextlib.suppress(OSError):
        return int.from_bytes(fcntl.ioctl(fd, termios.TIOCOUTQ, bytes(4)), sys.byteorder)
    return 0


def main() -> int:
    # What ends the daemon in order may be sent to all its processes, and must not end this one before.
    for number in signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP, signal.SIGCHLD}:
        signal.signal(number, signal.SIG_IGN)
    told = b""
    while data := os.read(0, len(CLOSED)):
        told += data
    if told != CLOSED:
        said = take_force_off(sys.argv[1], int(sys.argv[2]), bytes.fromhex(sys.argv[3]))
        print(f"softfinger watcher: the daemon has died: {said}", file=sys.stderr, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
