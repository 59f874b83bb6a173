"""Options of `softfinger bridge`."""

from __future__ import annotations

from typing import Final

from softfinger.server.arguments import Parser, add_daemon_options, add_option, add_stream_options

FOXGLOVE_PORT: Final = 8765


def configure_bridge(parser: Parser) -> None:
    parser.description = (
        "Show a running daemon in Foxglove or Rerun (extras foxglove and rerun), or a recording in Rerun. Exits when "
        "the daemon ends, or on Ctrl-C."
    )
    add_option(parser, "viewer", "program to show it in", choices=["foxglove", "rerun"])
    add_option(parser, "recording", "recording to show in Rerun; default: a running daemon", metavar="FILE", nargs="?")
    add_daemon_options(parser, commands=True)
    add_option(parser, "--port", "local port for Foxglove", default=FOXGLOVE_PORT)
    add_option(parser, "--save", "Rerun: write a file, without a viewer", metavar="RRD")
    add_option(
        parser, "--connect", "Rerun: connect to a running viewer, such as rerun+http://HOST:9876/proxy", metavar="URL"
    )
    add_stream_options(parser)
