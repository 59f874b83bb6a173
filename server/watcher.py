"""Watcher: process that zeroes the force of a device if its daemon was killed.

It only waits for the end of a pipe whose other end the daemon has open. A daemon that has closed its device first
writes CLOSED_MESSAGE to the pipe, and the watcher exits. Otherwise the daemon has died, by SIGKILL or a fault in a
library, and the watcher writes the given zero frame to the device. It inherits an open descriptor, because it could not
always open the node: a serial port opened for exclusive use remains so until the last process that has it open closes
it. It opens a node on the USB bus itself, and claims the interface when the system has released it from the daemon.

This file runs as a script without this package, so that the process is small and needs no compiler.
"""

from __future__ import annotations

import array
import contextlib
import fcntl
import os
import signal
import struct
import subprocess
import sys
import termios
import time

CLOSED_MESSAGE = b"closed"
ZERO_WRITES = 3
"""The first zero may follow an incomplete frame of the daemon."""
PAUSE_S = 0.005
WRITE_TIMEOUT_S = 2.0
"""Time limit for a device that accepts no bytes."""
EXIT_TIMEOUT_S = 2.0
"""Time limit for the process to exit; a stopped process (SIGSTOP) does not."""
USB_TIMEOUT_MS = 100
"""Time limit of one transfer."""
# From <linux/usbdevice_fs.h>; struct usbdevfs_bulktransfer: endpoint, length, timeout in ms, address of the data.
BULK_TRANSFER = "IIIP"
CLAIM_INTERFACE, BULK = 0x8004550F, 0xC0005502 | struct.calcsize(BULK_TRANSFER) << 16
RESTARTS = 3
"""Maximum restarts of a process that ends unexpectedly."""


class Watcher:
    """Starts the process; call `supervise` repeatedly, and `dismiss` after the device is closed.

    Parameters
    ----------
    node
        Path of the device node.
    fd
        Descriptor of the open device; None on the USB bus.
    zero
        Bytes that command zero force when written to it.
    interface, endpoint
        Destination of these bytes on the USB bus; endpoint 0 for other nodes.
    """

    def __init__(self, node: str, fd: int | None, zero: bytes, interface: int, endpoint: int) -> None:
        self._node, self._restarts = node, 0
        self._fds = () if fd is None else (fd,)
        self._command = [sys.executable, "-I", "-S", __file__, node, str(fd), zero.hex(), f"{interface}", f"{endpoint}"]
        self._process = self._spawn()

    def _spawn(self) -> subprocess.Popen[bytes]:
        # A new session: Ctrl-C and the hangup of a terminal are meant for the daemon.
        return subprocess.Popen(self._command, stdin=subprocess.PIPE, pass_fds=self._fds, start_new_session=True)

    def supervise(self) -> str:
        """Restart the process if it has ended; return a sentence about it, empty if the process runs."""
        if self._restarts > RESTARTS or (code := self._process.poll()) is None:
            return ""
        self._restarts += 1
        if self._restarts <= RESTARTS:
            with self._process, contextlib.suppress(OSError):  # closes the pipe of the ended process
                self._process = self._spawn()
                return f"the watcher of {self._node} ended unexpectedly ({code}) and was restarted"
        self._restarts = RESTARTS + 1
        return (
            f"the watcher of {self._node} ended unexpectedly ({code}) and is not restarted: if this program is killed, "
            "the last force may remain"
        )

    def dismiss(self) -> None:
        """End the process after the device was closed."""
        with self._process:  # closes the pipe and waits
            if self._process.poll() is not None:
                return
            try:
                self._process.communicate(CLOSED_MESSAGE, EXIT_TIMEOUT_S)
            except subprocess.TimeoutExpired:
                self._process.kill()


def send(fd: int, data: bytes, interface: int, endpoint: int) -> int:
    """Write bytes to a node, or to an endpoint on the USB bus; return how many were accepted."""
    if not endpoint:
        return os.write(fd, data)
    fcntl.ioctl(fd, CLAIM_INTERFACE, struct.pack("I", interface))
    buffer = array.array("B", data)
    address, length = buffer.buffer_info()
    transfer = bytearray(struct.pack(BULK_TRANSFER, endpoint, length, USB_TIMEOUT_MS, address))
    accepted: int = fcntl.ioctl(fd, BULK, transfer)
    return accepted


def write_zero_force(node: str, fd: int, zero: bytes, interface: int = 0, endpoint: int = 0) -> str:
    """Discard the unsent bytes of a device's port and write the zero frame; return the result as a sentence."""
    until, zeroed_count, detail = time.monotonic() + WRITE_TIMEOUT_S, 0, "only part of it was accepted"
    with contextlib.suppress(OSError, termios.error):  # no serial port, or disconnected
        termios.tcflush(fd, termios.TCOFLUSH)
    while zeroed_count < ZERO_WRITES and time.monotonic() < until:
        try:
            zeroed_count += send(fd, zero, interface, endpoint) == len(zero)
        except OSError as error:
            detail = error.strerror or str(error)
        time.sleep(PAUSE_S)
    while zeroed_count and _count_unsent(fd) and time.monotonic() < until:
        time.sleep(PAUSE_S)
    remainder = (
        f", but {count} bytes of it are queued in the port: switch the device off"
        if (count := _count_unsent(fd))
        else ""
    )
    with contextlib.suppress(OSError):  # no serial port, or disconnected
        fcntl.ioctl(fd, termios.TIOCNXCL)  # as on a regular close: the next daemon may have another user
    return (
        f"zero force was written to {node}{remainder}"
        if zeroed_count
        else f"zero force could not be written to {node}: {detail}"
    )


def _count_unsent(fd: int) -> int:
    """Return the number of unsent bytes of a serial port; 0 for other devices."""
    with contextlib.suppress(OSError):
        return int.from_bytes(fcntl.ioctl(fd, termios.TIOCOUTQ, bytes(4)), sys.byteorder)
    return 0


def main() -> int:
    # Signals that end the daemon may be sent to its process group, and must not end this process first.
    for number in signal.valid_signals() - {signal.SIGKILL, signal.SIGSTOP, signal.SIGCHLD}:
        signal.signal(number, signal.SIG_IGN)
    _, node, fd_text, zero, interface, endpoint = sys.argv
    fd = os.open(node, os.O_RDWR) if int(endpoint) else int(fd_text)
    received = b""
    while data := os.read(0, len(CLOSED_MESSAGE)):
        received += data
    if received != CLOSED_MESSAGE:
        result = write_zero_force(node, fd, bytes.fromhex(zero), int(interface), int(endpoint))
        print(f"softfinger watcher: the daemon has died: {result}", file=sys.stderr, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
