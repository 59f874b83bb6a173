"""Options of `softfinger bridge`."""

from __future__ import annotations

import argparse
from typing import Final

from softfinger.server.arguments import add_endpoint_option, add_key_options

FOXGLOVE_PORT: Final = 8765
"""Default port of Foxglove."""


def configure_bridge(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Show a running daemon in Foxglove or Rerun (extras foxglove and rerun), or a recording in Rerun; "
        "ends with the server, or with Ctrl-C."
    )
    parser.add_argument("viewer", choices=["foxglove", "rerun"], help="which")
    parser.add_argument("recording", nargs="?", metavar="FILE", help="a recording for Rerun, in place of a daemon")
    add_endpoint_option(parser)
    parser.add_argument(
        "--commands", metavar="URL", help="endpoint of the daemon's description (default: next to that of telemetry)"
    )
    add_key_options(parser)
    parser.add_argument(
        "--port", type=int, default=FOXGLOVE_PORT, help="of the server for Foxglove, on this machine only (%(default)s)"
    )
    parser.add_argument("--save", metavar="RRD", help="Rerun: into a file, without a viewer")
    parser.add_argument(
        "--connect", metavar="URL", help="Rerun: to a viewer that runs, as rerun+http://HOST:9876/proxy"
    )
    parser.add_argument("--duration", type=float, metavar="S", help="leave after S seconds of ticks (default: stay)")
    parser.add_argument("--timeout", type=float, metavar="S", default=3.0, help="end after S seconds of silence")
