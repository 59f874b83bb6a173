"""Options of the verbs in this folder."""

from __future__ import annotations

from pathlib import Path

from softfinger.server.arguments import Parser, add_flag, add_option
from softfinger.server.wire import DEFAULT_ENDPOINT


def configure_forward(parser: Parser) -> None:
    parser.description = (
        "Forward the telemetry of a daemon to subscribers on other machines and their commands to the daemon. "
        "Endpoints that are open to the network require keys. Ctrl-C stops and prints the number of messages."
    )
    add_option(
        parser,
        "--from",
        "telemetry or commands endpoint of the daemon",
        default=DEFAULT_ENDPOINT,
        metavar="URL",
        dest="source",
    )
    add_option(parser, "--to", "endpoint to publish on, such as tcp://0.0.0.0:5565", metavar="URL")
    add_flag(parser, "--lsl", "publish as a Lab Streaming Layer stream, readable by the whole network (extra lsl)")
    add_option(
        parser, "--commands-from", "commands endpoint of the daemon (default: derived from --from)", metavar="URL"
    )
    add_option(parser, "--commands-to", "endpoint to receive commands on", metavar="URL")
    add_option(parser, "--keys", "secret key of this gateway; required for a URL open to the network", metavar="FILE")
    add_option(parser, "--readers", "folder with the public keys of allowed subscribers", metavar="DIR")
    add_option(parser, "--commanders", "folder with the public keys of clients that may send commands", metavar="DIR")
    add_option(parser, "--server-key", "public key of the daemon, if its endpoints require keys", metavar="FILE")
    add_flag(parser, "--until-eof", "exit when standard input is closed, for use by a parent program")
    add_flag(parser, "--json", "print counts of forwarded messages as JSON")


def configure_keys(parser: Parser) -> None:
    parser.description = (
        "Create a key pair for each name: the public key NAME.key and the secret key NAME.key_secret (mode 600). "
        "Existing files are not overwritten."
    )
    add_option(parser, "folder", "output folder; created if missing", type=Path)
    add_option(parser, "names", "name of a machine or a person", metavar="NAME", nargs="+")
    add_flag(parser, "--json", "print the file names as JSON")
