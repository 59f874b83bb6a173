"""Search of /proc for the process that listens on a TCP port of this machine."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

LISTENING: Final = "0A"
"""State in proc_pid_net(5)."""


def listener_on(port: int) -> str:
    """Return the process, in the wording of messages; empty if none is visible, as for the files of other users."""
    sockets = _sockets(port)
    for folder in Path("/proc").glob("[0-9]*/fd"):
        try:
            if any(os.readlink(entry) in sockets for entry in folder.iterdir()):
                name = (folder.parent / "comm").read_text().strip()
                return f"process {folder.parent.name} ({name})"
        except OSError:  # it has exited, or belongs to another user
            continue
    return ""


def _sockets(port: int) -> set[str]:
    """Return the links in /proc/PID/fd of the sockets that listen on a port."""
    found = set()
    for table in ("tcp", "tcp6"):
        try:
            lines = Path("/proc/net", table).read_text().splitlines()[1:]
        except OSError:
            continue
        for words in map(str.split, lines):
            if words[3] == LISTENING and int(words[1].rpartition(":")[2], 16) == port:
                found.add(f"socket:[{words[9]}]")
    return found
