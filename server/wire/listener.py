"""Which process listens on a TCP port of this machine, as /proc says it."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

LISTENING: Final = "0A"
"""State in proc_pid_net(5)."""


def listener_on(port: int) -> str:
    """The process, as messages name it; empty where nobody can be seen to: others' open files are not this user's."""
    sockets = _sockets(port)
    for folder in Path("/proc").glob("[0-9]*/fd"):
        try:
            if any(os.readlink(entry) in sockets for entry in folder.iterdir()):
                name = (folder.parent / "comm").read_text().strip()
                return f"process {folder.parent.name} ({name})"
        except OSError:  # it has ended, or is another user's
            continue
    return ""


def _sockets(port: int) -> set[str]:
    """Links, as open files have them, of the sockets that listen on a port."""
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
