"""Options of `softfinger bridge`."""

from __future__ import annotations

import argparse
from typing import Final

from softfinger.server.arguments import add_daemon_options, add_stream_options

FOXGLOVE_PORT: Final = 8765
"""Default port of Foxglove."""


def configure_bridge(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Show a running daemon in Foxglove or Rerun (extras foxglove and rerun), or a recording in Rerun. Exits when "
        "the daemon ends, or on Ctrl-C."
    )
    parser.add_argument("viewer", choices=["foxglove", "rerun"], help="program to show it in")
    parser.add_argument(
        "recording", nargs="?", metavar="FILE", help="recording to show in Rerun; default: a running daemon"
    )
    add_daemon_options(parser, commands=True)
    parser.add_argument(
        "--port", type=int, default=FOXGLOVE_PORT, help="local port for Foxglove (default: %(default)s)"
    )
    parser.add_argument("--save", metavar="RRD", help="Rerun: write a file, without a viewer")
    parser.add_argument(
        "--connect", metavar="URL", help="Rerun: connect to a running viewer, such as rerun+http://HOST:9876/proxy"
    )
    add_stream_options(parser)
