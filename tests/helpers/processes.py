"""Command line of the program, and processes of a daemon."""

import sys
from contextlib import suppress
from pathlib import Path
from typing import Final

from helpers.waits import eventually

COMMAND: Final = [sys.executable, "-m", "softfinger.server.cli"]


def read_command_line(pid: int) -> bytes:
    """Return the command line of a process, with zeros between its arguments; empty after its end."""
    with suppress(FileNotFoundError, ProcessLookupError):
        return Path(f"/proc/{pid}/cmdline").read_bytes()
    return b""


def list_children(pid: int, words: bytes = b"") -> list[int]:
    """Return the children with `words` in their command line, of all threads: the one that supervises restarts them."""
    pids: list[int] = []
    for thread in Path(f"/proc/{pid}/task").glob("*/children"):
        with suppress(FileNotFoundError, ProcessLookupError):
            pids += map(int, thread.read_text().split())
    return [child for child in pids if words in read_command_line(child)]


def find_child(pid: int, words: bytes) -> int:
    """Wait until a process has one child with `words` in its command line."""
    children: list[int] = eventually(lambda: list_children(pid, words), every_s=0.01)
    assert len(children) == 1, f"children with {words!r}: {children}"
    return children[0]


def read_memory(pid: int, field: str = "VmRSS") -> int:
    """Return a size in /proc/PID/status, bytes; VmHWM is the peak of the resident memory."""
    (line,) = [line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith(field)]
    return 1024 * int(line.split()[1])


def read_state(pid: int) -> str:
    """Return the state of a process from the kernel, such as T (stopped) or Z (zombie); empty after its end."""
    with suppress(FileNotFoundError, ProcessLookupError):
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    return ""


def has_exited(pid: int) -> bool:
    """Return True if a process has exited, also as a zombie."""
    return read_state(pid) in ("", "Z")
