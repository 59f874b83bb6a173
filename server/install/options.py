"""Options of `softfinger install`."""

from __future__ import annotations

from pathlib import Path

from softfinger.server.arguments import Parser


def configure_install(parser: Parser) -> None:
    parser.description = (
        "Install the systemd unit, the man page and shell completion for this user. With --system, install them for "
        "all users, with udev rules for every supported device and real-time limits. --remove removes the installed "
        "files. Files of other origin are not overwritten; edited files are not removed."
    )
    parser.flag("--system", "install for all users, with udev rules and limits; requires root")
    parser.flag("--remove", "remove the installed files")
    parser.flag("--dry-run", "print the planned changes with the content of each file")
    parser.argument("--rig", None, "rig of the service", default="replay")
    parser.argument("--scene", None, "scene of the service", default="paper-plane")
    parser.argument("--root", "DIR", "install below DIR and run no commands, for packagers", type=Path)
