"""`softfinger install`: install the files that a machine needs besides the program; `--remove` removes all of them."""

from __future__ import annotations

import argparse
import shlex
import shutil
import subprocess
from collections.abc import Iterable
from pathlib import Path
from typing import Final

from softfinger.drivers.system.rules import GROUP, install_command
from softfinger.server.install.ledger import Ledger
from softfinger.server.install.plan import find_private_folder, install_paths, list_files, make_service_command

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
        try:
            result = subprocess.run(command, capture_output=True, text=True, timeout=WAIT_S, stdin=subprocess.DEVNULL)
        except subprocess.TimeoutExpired:
            print(f"not finished within {WAIT_S:g} s: {shlex.join(command)}")
            continue
        output = (result.stderr or result.stdout).strip().splitlines()
        print(
            f"ran {shlex.join(command)}"
            + (f": {output[-1] if output else result.returncode}" if result.returncode else "")
        )


ROOT: Final = Path("/")

ADMIN_STEPS: Final = """\
The user at this machine may open a device once it is plugged in again; over ssh, and for the limits, join
the group and log in again:
  sudo usermod -aG softfinger $USER
The daemon as a service, and its log:
  sudo systemctl start softfinger
  journalctl -u softfinger -f
"""
USER_STEPS: Final = """\
The daemon as a service, and its log:
  systemctl --user start softfinger
  journalctl --user -u softfinger -f
Rules for devices and limits for real time are the machine's: {command}
"""


def run(args: argparse.Namespace) -> int:
    ledger = Ledger((args.root or ROOT).resolve(), install_paths(args.system).record)
    if args.remove:
        remove(args, ledger)
    else:
        install(args, ledger)
    return 0


def install(args: argparse.Namespace, ledger: Ledger) -> None:
    from softfinger.server.cli import make_parser

    files_to_write = list_files(args.system, args.rig, args.scene, make_parser().complete())
    commands = list_activation_commands(args.system)
    if args.dry_run:
        paths = install_paths(args.system)
        for file in files_to_write:
            is_generated = file.path.parent in (paths.manuals, paths.bash, paths.zsh)
            text = f"({len(file.text.splitlines())} lines from the help texts)\n" if is_generated else file.text
            print(f"##### {file.path}: {ledger.state(file)}\n{text}")
        print("\n".join(f"##### then: {shlex.join(words)}" for words in commands))
        return
    for action in ledger.write(files_to_write):
        print(action)
    if args.root is None:
        run_all(commands)
    private_folder = find_private_folder(make_service_command(args.rig, args.scene)) if args.system else None
    if private_folder is not None:
        print(
            f"the service cannot start: {private_folder} is readable by its owner only; "
            "move the program to /opt/softfinger"
        )
    print(ADMIN_STEPS if args.system else USER_STEPS.format(command=install_command()), end="")


def remove(args: argparse.Namespace, ledger: Ledger) -> None:
    if ledger.empty:
        print(f"nothing was installed{'' if args.system else ' for this user; for the machine: --system'}")
    elif args.dry_run:
        print("\n".join(f"##### would be removed: {path}" for path in ledger.paths))
    else:
        ledger.check()  # before the service is stopped
        if args.root is None:
            run_all(list_stop_commands(args.system))
        for action in ledger.remove():
            print(action)
        if args.root is None:
            run_all(list_cleanup_commands(args.system))
            if args.system and STATE.exists():
                print(f"data of the service remain in {STATE}, and so does its account")
