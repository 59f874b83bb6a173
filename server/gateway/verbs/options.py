"""Options of the verbs in this folder."""

from __future__ import annotations

import argparse
from pathlib import Path

from softfinger.server.wire import DEFAULT_ENDPOINT


def configure_forward(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Forward the telemetry of a daemon to subscribers on other machines and their commands to the daemon. "
        "Endpoints that are open to the network require keys. Ctrl-C stops and prints the number of messages."
    )
    parser.add_argument(
        "--from",
        dest="source",
        metavar="URL",
        default=DEFAULT_ENDPOINT,
        help="telemetry or commands endpoint of the daemon (default: %(default)s)",
    )
    parser.add_argument("--to", metavar="URL", help="endpoint to publish on, such as tcp://0.0.0.0:5565")
    parser.add_argument(
        "--lsl",
        action="store_true",
        help="publish as a Lab Streaming Layer stream, readable by the whole network (extra lsl)",
    )
    parser.add_argument(
        "--commands-from", metavar="URL", help="commands endpoint of the daemon (default: derived from --from)"
    )
    parser.add_argument("--commands-to", metavar="URL", help="endpoint to receive commands on")
    parser.add_argument(
        "--keys", metavar="FILE", help="secret key of this gateway; required for a URL open to the network"
    )
    parser.add_argument("--readers", metavar="DIR", help="folder with the public keys of allowed subscribers")
    parser.add_argument(
        "--commanders", metavar="DIR", help="folder with the public keys of clients that may send commands"
    )
    parser.add_argument("--server-key", metavar="FILE", help="public key of the daemon, if its endpoints require keys")
    parser.add_argument(
        "--until-eof", action="store_true", help="exit when standard input is closed, for use by a parent program"
    )
    parser.add_argument("--json", action="store_true", help="print counts of forwarded messages as JSON")


def configure_keys(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Create a key pair for each name: the public key NAME.key and the secret key NAME.key_secret (mode 600). "
        "Existing files are not overwritten."
    )
    parser.add_argument("folder", type=Path, help="output folder; created if missing")
    parser.add_argument("names", nargs="+", metavar="NAME", help="name of a machine or a person")
    parser.add_argument("--json", action="store_true", help="print the file names as JSON")
