"""Options of `softfinger install`."""

from __future__ import annotations

import argparse
from pathlib import Path


def configure_install(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Install the systemd unit, the man page and shell completion for this user. With --system, install them for "
        "all users, with udev rules for every supported device and real-time limits. --remove removes the installed "
        "files. Files of other origin are not overwritten; edited files are not removed."
    )
    parser.add_argument(
        "--system", action="store_true", help="install for all users, with udev rules and limits; requires root"
    )
    parser.add_argument("--remove", action="store_true", help="remove the installed files")
    parser.add_argument(
        "--dry-run", action="store_true", help="print the planned changes with the content of each file"
    )
    parser.add_argument("--rig", default="replay", help="rig of the service (default: %(default)s)")
    parser.add_argument("--scene", default="paper-plane", help="scene of the service (default: %(default)s)")
    parser.add_argument("--root", type=Path, metavar="DIR", help="install below DIR and run no commands, for packagers")
