"""Options of `softfinger install`."""

from __future__ import annotations

from pathlib import Path

from softfinger.server.arguments import Parser, add_flag, add_option


def configure_install(parser: Parser) -> None:
    parser.description = (
        "Install the systemd unit, the man page and shell completion for this user. With --system, install them for "
        "all users, with udev rules for every supported device and real-time limits. --remove removes the installed "
        "files. Files of other origin are not overwritten; edited files are not removed."
    )
    add_flag(parser, "--system", "install for all users, with udev rules and limits; requires root")
    add_flag(parser, "--remove", "remove the installed files")
    add_flag(
        parser,
        "--dry-run",
        "print the planned changes, with the content of each file that does not repeat the help texts",
    )
    add_option(parser, "--rig", "rig of the service", default="replay")
    add_option(parser, "--scene", "scene of the service", default="paper-plane")
    add_option(parser, "--root", "install below DIR and run no commands, for packagers", metavar="DIR", type=Path)
