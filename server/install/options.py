"""Options of `softfinger install`."""

from __future__ import annotations

import argparse
from pathlib import Path


def configure_install(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Write the systemd unit, the man page and shell completion for this user, or with --system for the "
        "machine, with udev rules for every supported device and limits for real time. The files are recorded, "
        "and --remove removes them; files of other origin are not overwritten, and edited files not removed."
    )
    parser.add_argument("--system", action="store_true", help="for all users, as root; with rules and limits")
    parser.add_argument("--remove", action="store_true", help="remove the written files")
    parser.add_argument("--dry-run", action="store_true", help="print the planned changes, each file with its content")
    parser.add_argument("--rig", default="replay", help="rig of the service, and its devices (default: %(default)s)")
    parser.add_argument("--scene", default="paper-plane", help="scene of the service (default: %(default)s)")
    parser.add_argument("--root", type=Path, metavar="DIR", help="write below DIR, and run no command: for packagers")
