"""Options of the verbs in this folder."""

from __future__ import annotations

from pathlib import Path

from softfinger.server.arguments import Parser
from softfinger.server.wire import DEFAULT_ENDPOINT


def configure_forward(parser: Parser) -> None:
    parser.description = (
        "Forward the telemetry of a daemon to subscribers on other machines and their commands to the daemon. "
        "Endpoints that are open to the network require keys. Ctrl-C stops and prints the number of messages."
    )
    parser.argument(
        "--from", "URL", "telemetry or commands endpoint of the daemon", dest="source", default=DEFAULT_ENDPOINT
    )
    parser.argument("--to", "URL", "endpoint to publish on, such as tcp://0.0.0.0:5565")
    parser.flag("--lsl", "publish as a Lab Streaming Layer stream, readable by the whole network (extra lsl)")
    parser.argument("--commands-from", "URL", "commands endpoint of the daemon (default: derived from --from)")
    parser.argument("--commands-to", "URL", "endpoint to receive commands on")
    parser.argument("--keys", "FILE", "secret key of this gateway; required for a URL open to the network")
    parser.argument("--readers", "DIR", "folder with the public keys of allowed subscribers")
    parser.argument("--commanders", "DIR", "folder with the public keys of clients that may send commands")
    parser.argument("--server-key", "FILE", "public key of the daemon, if its endpoints require keys")
    parser.flag("--until-eof", "exit when standard input is closed, for use by a parent program")
    parser.flag("--json", "print counts of forwarded messages as JSON")


def configure_keys(parser: Parser) -> None:
    parser.description = (
        "Create a key pair for each name: the public key NAME.key and the secret key NAME.key_secret (mode 600). "
        "Existing files are not overwritten."
    )
    parser.argument("folder", None, "output folder; created if missing", type=Path)
    parser.argument("names", "NAME", "name of a machine or a person", nargs="+")
    parser.flag("--json", "print the file names as JSON")
