"""Options of the verbs in this folder.

Their modules import the compiler or numpy, which takes longer than a help text.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, Final

from softfinger.server.arguments import add_daemon_options, add_stream_options, duration
from softfinger.server.offline.figures import plot_file
from softfinger.server.viewer.roles import Role

RIG: Final = "replay"
VIEW_RIG: Final = "simulated-hand"
"""Rig for --view, in which the mouse moves the hand."""
PAGE_PORT: Final = 8080
PAGE_HOST: Final = "127.0.0.1"
SCHEMAS: Final = ("scene", "rig", "experiment", "telemetry", "commands")

# Options that override a key of the rig: flag, key, type, metavar, help.
OVERRIDES: Final[tuple[tuple[str, str, Any, str, str], ...]] = (
    ("--device", "device.driver", str, "D", "driver that replaces the rig's"),
    ("--recording", "device.recording", str, "P", "poses to replay: a file or the name of a shipped recording"),
    ("--forces", "device.forces", str, "FILE", "output file for the forces of a replay: .csv or .npz"),
    ("--rate", "servo.rate_hz", float, "HZ", "ticks per second, 100 to 8000"),
    ("--realtime", "servo.realtime", str, "MODE", "real-time settings: auto, require or off"),
    ("--endpoint", "telemetry.endpoint", str, "URL", "endpoint for telemetry"),
    ("--commands", "commands.endpoint", str, "URL", "endpoint for commands; off: none"),
    ("--metrics", "metrics.endpoint", "127.0.0.1:{}".format, "PORT", "port for Prometheus metrics; 0: any free port"),
)


def configure_run(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--rig",
        help=f"rig file or the name of a shipped one (default: simulated-SCENE if it exists, else {RIG}; with --view "
        f"{VIEW_RIG})",
    )
    parser.add_argument("--scene", default="paper-plane", help="scene file or name (default: %(default)s)")
    for flag, _, kind, metavar, text in OVERRIDES:
        parser.add_argument(flag, type=kind, metavar=metavar, help=text)
    parser.add_argument("--once", action="store_true", help="play a recording once instead of looping it")
    parser.add_argument(
        "--watcher", action="store_true", help="start a second process that removes the force if this one is killed"
    )
    parser.add_argument("--record", metavar="FILE", help="record every tick and event to a new .mcap file")
    parser.add_argument(
        "--inject", metavar="FILE", help="inject faults between device and loop: a file or the name of a shipped one"
    )
    parser.add_argument("--view", action="store_true", help="open a browser page on which the mouse moves the hand")
    parser.add_argument("--duration", type=duration, metavar="S", help="stop after S seconds of ticks")


def configure_simulate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scene", default="paper-plane", help="scene file or name (default: %(default)s)")
    poses_or_device = parser.add_mutually_exclusive_group(required=True)
    poses_or_device.add_argument(
        "--poses",
        action="append",
        metavar="P",
        help="CSV, npz or MCAP file, or a shipped recording; for several fingers one MCAP, or NAME=P for each",
    )
    poses_or_device.add_argument(
        "--device", metavar="D", help="driver of a device that responds to the force: simulated"
    )
    parser.add_argument("--out", required=True, type=Path, help="output file: .csv, .npz or .mcap")
    parser.add_argument(
        "--plot", type=plot_file, metavar="FILE.png", help="plot depth, force, angles and modes (.png, .svg)"
    )
    parser.add_argument("--duration", type=duration, metavar="S", help="with --device: simulated time (default: 10)")
    parser.add_argument("--method", help="rolling method that replaces the scene's")
    parser.add_argument("--rate", type=float, metavar="HZ", help="tick rate that replaces the rig's (default: 1000)")
    parser.add_argument(
        "--rig",
        help="rig with the force limits and device options (default: replay; with --device simulated-SCENE if it "
        "exists, else simulated)",
    )


def configure_monitor(parser: argparse.ArgumentParser) -> None:
    parser.description = "Show contact mode, forces, lateness and events of a running server."
    add_daemon_options(parser)
    parser.add_argument("--once", action="store_true", help="print one summary and exit")
    parser.add_argument("--json", action="store_true", help="print one JSON object per line")
    add_stream_options(parser)


def configure_view(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Open a browser page that shows a recording, or a running daemon whose simulated hand the mouse can move."
    )
    parser.add_argument(
        "recording",
        nargs="?",
        metavar="RECORDING",
        help="MCAP file, results, poses, or the name of a shipped recording",
    )
    parser.add_argument("--scene", help="scene for a recording; replaces the recorded one")
    parser.add_argument(
        "--tick", type=int, default=0, metavar="N", help="first tick of the recording to show (default: %(default)s)"
    )
    add_daemon_options(parser, commands=True)
    parser.add_argument(
        "--role",
        choices=[role.value for role in Role],
        default=Role.OPERATOR.value,
        help="role of the user: a watcher changes nothing, a participant sees only prompts (default: %(default)s)",
    )
    parser.add_argument("--host", default=PAGE_HOST, help="address to serve the page on (default: %(default)s)")
    parser.add_argument(
        "--allow-host",
        action="append",
        default=[],
        metavar="NAME[:PORT]",
        help="additional host name of the page, such as that of a tunnel or proxy; repeatable",
    )
    parser.add_argument(
        "--port",
        type=int,
        default=PAGE_PORT,
        help="port of the page; the next free port if it is in use (default: %(default)s)",
    )
    parser.add_argument("--print-address", action="store_true", help="print only the address, for use by programs")
    # For `run --view`. The first line of standard input is the token, or empty for a new one; end of input ends the
    # page.
    parser.add_argument("--until-eof", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--no-open", action="store_true", help="do not open a browser")
    parser.add_argument(
        "--duration", type=duration, metavar="S", help="exit after S seconds (default: run until Ctrl-C)"
    )


def configure_record(parser: argparse.ArgumentParser) -> None:
    parser.description = "Record a running daemon: all telemetry to .mcap, or only poses to .csv."
    parser.add_argument(
        "file", nargs="?", metavar="FILE", help="new file: .mcap for ticks, events and scene; .csv for poses"
    )
    parser.add_argument(
        "--poses",
        action="append",
        metavar="FILE",
        help=".csv for poses, .mcap for all telemetry; NAME=FILE for each of several fingers",
    )
    add_daemon_options(parser, commands=True)
    add_stream_options(parser)


def configure_ctl(parser: argparse.ArgumentParser) -> None:
    from softfinger.server.wire.commands import METHODS, table

    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    width = max(map(len, METHODS))
    methods = "\n".join(
        f"  {name:{width}}  {meaning}{f' ({params})' if params else ''}"
        for name, (params, _, meaning) in table().items()
    )
    parser.epilog = (
        f"methods:\n{methods}\n\n"
        "examples:\n"
        "  softfinger ctl get_state\n"
        "  softfinger ctl set_params object.table.material.stiffness_n_per_m=800\n"
        "  softfinger ctl set_scene scene=sphere          # or a file: scene=mine.toml\n"
        "  softfinger ctl drive object=lid 'position_m=[0, 0, 0.01]'"
    )
    parser.add_argument("method", metavar="METHOD", help="one of the methods below")
    parser.add_argument(
        "params",
        nargs="*",
        metavar="key=value",
        help="parameters of the method; values in TOML or JSON, otherwise text",
    )
    add_daemon_options(parser)
    parser.add_argument(
        "--timeout", type=duration, metavar="S", help="time limit for the answer (default: depends on the method)"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def configure_scenes(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print names, files and descriptions as JSON")


configure_rigs = configure_recordings = configure_faults = configure_experiments = configure_scenes


def configure_materials(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        'List the materials (material = "rubber") and fingertips (fingertip = "human-index") that a scene can use.'
    )
    parser.add_argument("name", nargs="?", metavar="NAME", help="show the values, ranges and sources of this one")
    parser.add_argument(
        "--plot", type=plot_file, metavar="FILE", help="plot it with published measurements (.png, .svg)"
    )
    parser.add_argument("--json", action="store_true", help="print as JSON")


def configure_check(parser: argparse.ArgumentParser) -> None:
    parser.description = "Validate scenes, rigs and experiments. Exit code 0: all are valid; 2: at least one is not."
    parser.add_argument(
        "files", nargs="+", metavar="FILE", help="scene, rig or experiment: a file or the name of a shipped one"
    )
    parser.add_argument(
        "--explain", action="store_true", help="compile each scene and measure the cost of a tick and of its parts"
    )
    parser.add_argument(
        "--plot",
        type=plot_file,
        metavar="FILE.png",
        help="plot the workspace limit of a rig with the objects of a scene",
    )
    parser.add_argument("--json", action="store_true", help="print the findings as JSON")


def configure_schema(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Print the JSON Schema of scenes, rigs, experiments and commands, and the fields of telemetry records."
    )
    parser.add_argument("kind", nargs="?", choices=SCHEMAS, help="schema to print (default: all, as one object)")
    parser.add_argument("--markdown", action="store_true", help="print tables of the keys as Markdown")


def configure_warmup(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="scenes to compile (default: all shipped ones)")
    parser.add_argument("--prune", action="store_true", help="first remove compiled kernels of other versions")
