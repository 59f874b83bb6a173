"""System commands before and after files are changed; commands that are not installed are skipped."""

from __future__ import annotations

import shlex
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from softfinger.drivers.system.rules import GROUP

Command = tuple[str, ...]

SERVICE: Final = "softfinger.service"
STATE: Final = Path("/var/lib/softfinger")
"""Working directory of the service, with the recordings that it made."""

RULES: Final[tuple[Command, ...]] = (
    ("udevadm", "control", "--reload"),
    ("udevadm", "trigger", *(f"--subsystem-match={subsystem}" for subsystem in ("usb", "hidraw", "tty", "misc"))),
)
WAIT_S: Final = 60.0


def list_activation_commands(system: bool) -> list[Command]:
    """Return the commands that activate new files."""
    if not system:
        return [("systemctl", "--user", "daemon-reload")]
    return [("systemd-sysusers", "/etc/sysusers.d/softfinger.conf"), ("systemctl", "daemon-reload"), *RULES]


def list_stop_commands(system: bool) -> list[Command]:
    """Return the commands that stop the service and remove its compiled kernels, but not its recordings."""
    if not system:
        return [("systemctl", "--user", "disable", "--now", SERVICE)]
    return [("systemctl", "disable", "--now", SERVICE), ("systemctl", "clean", "--what=cache", SERVICE)]


def list_cleanup_commands(system: bool, state: Path = STATE) -> list[Command]:
    """Return the commands that deactivate removed files, and remove the account if `state` is empty."""
    if not system:
        return [("systemctl", "--user", "daemon-reload")]
    empty = not state.exists() or not any(state.iterdir())
    return [
        ("systemctl", "daemon-reload"),
        *RULES,
        *([("rmdir", str(state))] if empty and state.exists() else []),
        *([("userdel", GROUP)] if empty else []),
    ]


def run_all(commands: Iterable[Command]) -> None:
    """Run the available commands and print each with its result; a failure does not stop the next."""
    for command in commands:
        if shutil.which(command[0]) is None:
            print(f"not run, because {command[0]} is not installed: {shlex.join(command)}")
            continue
        result = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S, stdin=subprocess.DEVNULL)
        output = (result.stderr or result.stdout).strip().splitlines()
        print(
            f"ran {shlex.join(command)}"
            + (f": {output[-1] if output else result.returncode}" if result.returncode else "")
        )
