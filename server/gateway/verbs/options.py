"""Options of the verbs in this folder."""

from __future__ import annotations

import argparse
from pathlib import Path

from softfinger.server.wire import DEFAULT_ENDPOINT


def configure_forward(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Forward the telemetry of a daemon to any number of subscribers, by key to other machines, and their commands "
        "back; Ctrl-C ends it and prints the number of messages."
    )
    parser.add_argument(
        "--from",
        dest="source",
        metavar="URL",
        default=DEFAULT_ENDPOINT,
        help="of the daemon: its telemetry or its commands (%(default)s)",
    )
    parser.add_argument("--to", metavar="URL", help="where it is published again, such as tcp://0.0.0.0:5565")
    parser.add_argument(
        "--lsl",
        action="store_true",
        help="as a stream of Lab Streaming Layer, which everybody on the network can read (extra lsl)",
    )
    parser.add_argument(
        "--commands-from", metavar="URL", help="commands endpoint of the daemon (default: next to its telemetry)"
    )
    parser.add_argument("--commands-to", metavar="URL", help="where commands are taken for it")
    parser.add_argument("--keys", metavar="FILE", help="secret key of this end; needed for a URL open to the network")
    parser.add_argument("--readers", metavar="DIR", help="public keys of allowed subscribers")
    parser.add_argument("--commanders", metavar="DIR", help="public keys of allowed commanders")
    parser.add_argument("--server-key", metavar="FILE", help="public key of the daemon, if its endpoints require keys")
    parser.add_argument(
        "--until-eof",
        action="store_true",
        help="end when standard input is closed, so with the program that started this",
    )
    parser.add_argument("--json", action="store_true", help="print counts of forwarded messages as JSON")


def configure_keys(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Make a key pair for each name: NAME.key, which is public, and NAME.key_secret (mode 600), which is "
        "secret. Existing files are not overwritten."
    )
    parser.add_argument("folder", type=Path, help="where to; made if it is not there")
    parser.add_argument("names", nargs="+", metavar="NAME", help="of a machine or a person")
    parser.add_argument("--json", action="store_true", help="print the files as JSON")
