"""Options of `softfinger bridge`."""

from __future__ import annotations

from typing import Final

from softfinger.server.arguments import Parser, add_daemon_options, add_stream_options

FOXGLOVE_PORT: Final = 8765


def configure_bridge(parser: Parser) -> None:
    parser.description = (
        "Show a running daemon in Foxglove or Rerun (extras foxglove and rerun), or a recording in Rerun. Exits when "
        "the daemon ends, or on Ctrl-C."
    )
    parser.argument("viewer", None, "program to show it in", choices=["foxglove", "rerun"])
    parser.argument("recording", "FILE", "recording to show in Rerun; default: a running daemon", nargs="?")
    add_daemon_options(parser, commands=True)
    parser.argument("--port", None, "local port for Foxglove", type=int, default=FOXGLOVE_PORT)
    parser.argument("--save", "RRD", "Rerun: write a file, without a viewer")
    parser.argument("--connect", "URL", "Rerun: connect to a running viewer, such as rerun+http://HOST:9876/proxy")
    add_stream_options(parser)
