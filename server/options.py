"""Options of the verbs in folders below this one, except `verbs`, which has a separate file.

Modules of verbs import the compiler or numpy, which takes longer than a help text.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final

from softfinger.server.arguments import Parser, add_daemon_options, add_flag, add_option, add_stream_options
from softfinger.server.offline.figures import plot_file
from softfinger.server.wire import DEFAULT_ENDPOINT

TOLERANCE: Final = 1e-9
"""N, N m, m: possible difference between processors after many ticks; results on one machine are identical."""


def _add_recording(parser: Parser) -> None:
    kinds = "MCAP file, results or poses (.csv, .npz), or the name of a shipped recording"
    add_option(parser, "recording", kinds, metavar="RECORDING")


def configure_info(parser: Parser) -> None:
    _add_recording(parser)
    add_flag(parser, "--json", "print as JSON, with rig and scene")


def configure_export(parser: Parser) -> None:
    _add_recording(parser)
    add_option(parser, "--out", "output file: .csv, .parquet or .npz", metavar="FILE", type=Path, required=True)
    add_option(parser, "--finger", "finger to export, if there are several", default="", metavar="NAME")


def configure_import(parser: Parser) -> None:
    add_option(
        parser, "table", "text file, separated by commas, semicolons, tabs or blanks", metavar="TABLE", type=Path
    )
    add_option(parser, "--out", "output file for --recording and --poses", metavar="FILE.csv", type=Path, required=True)
    add_option(
        parser,
        "--columns",
        "quantity in each column: t,x,y,z,qw,qx,qy,qz, or - to ignore it; such as t,x,y,z,-,-,-",
        metavar="NAMES",
        required=True,
    )
    add_option(parser, "--unit-s", "unit of t in s; 0.001 for ms", default=1.0, metavar="S")
    add_option(parser, "--unit-m", "unit of x, y, z in m; 0.001 for mm", default=1.0, metavar="M")
    add_option(parser, "--rate", "rows per second of a table without times", metavar="HZ", type=float)
    add_option(parser, "--skip", "number of lines to skip at the start", default=0, metavar="N")


def configure_replay(parser: Parser) -> None:
    add_option(
        parser,
        "recording",
        "MCAP file; or poses (.csv, .npz, a shipped name) with --scene and --against",
        metavar="RECORDING",
    )
    add_option(parser, "--against", "reference forces: results, or the output of a replay", metavar="FORCES", type=Path)
    add_option(
        parser, "--tolerance", "largest allowed difference in N, N m and m", default=TOLERANCE, metavar="N", type=float
    )
    add_option(parser, "--scene", "scene that replaces the recorded one")
    add_option(parser, "--rig", "rig whose force limits replace the recorded ones")
    add_option(parser, "--rate", "tick rate for poses (default: 1000)", metavar="HZ", type=float)
    add_option(parser, "--plot", "plot both forces and their difference", metavar="FILE.png", type=plot_file)
    add_flag(parser, "--json", "print the result as JSON")


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


def configure_experiment(parser: Parser) -> None:
    parser.description = (
        "Run the trials of one participant in their order, starting at the first one without an answer. After a crash "
        "or Ctrl-C the same command continues the session."
    )
    add_option(parser, "file", "experiment file or the name of a shipped one", metavar="FILE")
    add_option(parser, "--out", "folder for all participants (default: name of the experiment)", metavar="FOLDER")
    add_option(parser, "--participant", "number of the participant, from 1", default=1, metavar="N")
    add_flag(parser, "--dry-run", "let a simulated observer answer and a simulated hand move")
    add_flag(parser, "--no-daemon", "with --dry-run: skip the rendering")
    add_flag(parser, "--no-doctor", "skip the check of the machine")
    add_flag(parser, "--view", "open a browser page for the participant")
    add_option(parser, "--rig", "rig that replaces the experiment's", metavar="RIG")
    add_option(parser, "--endpoint", "endpoint for telemetry", metavar="URL")
    add_option(parser, "--commands", "endpoint for commands", metavar="URL")
    add_option(
        parser, "--set", "override a key of the file; repeatable", default=[], metavar="KEY=VALUE", action="append"
    )


def configure_figure(parser: Parser) -> None:
    parser.description = (
        "Fit the answers of an experiment and write figures (PNG, SVG) and numbers (CSV, JSON). Existing figures are "
        "replaced."
    )
    add_option(parser, "folder", "folder written by `softfinger experiment`", metavar="FOLDER")
    add_option(parser, "--out", "output folder (default: FOLDER/figures)", metavar="FOLDER")
    add_flag(parser, "--report", "also write report.html, a page with all results")
    add_flag(parser, "--json", "print the numbers as JSON")
