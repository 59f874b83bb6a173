"""Options of the verbs in this folder.

Their modules import the compiler or numpy, which takes longer than a help text.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, Final

from softfinger.server.arguments import Parser, add_daemon_options, add_stream_options, duration
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


def configure_run(parser: Parser) -> None:
    parser.argument(
        "--rig",
        None,
        f"rig file or the name of a shipped one (default: simulated-SCENE if it exists, else {RIG}; with --view "
        f"{VIEW_RIG})",
    )
    parser.argument("--scene", None, "scene file or name", default="paper-plane")
    for flag, _, kind, metavar, text in OVERRIDES:
        parser.argument(flag, metavar, text, type=kind)
    parser.flag("--once", "play a recording once instead of looping it")
    parser.flag("--watcher", "start a second process that removes the force if this one is killed")
    parser.argument("--record", "FILE", "record every tick and event to a new .mcap file")
    parser.argument("--inject", "FILE", "inject faults between device and loop: a file or the name of a shipped one")
    parser.flag("--view", "open a browser page on which the mouse moves the hand")
    parser.argument("--duration", "S", "stop after S seconds of ticks", type=duration)


def configure_simulate(parser: Parser) -> None:
    parser.argument("--scene", None, "scene file or name", default="paper-plane")
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
    parser.argument("--out", None, "output file: .csv, .npz or .mcap", required=True, type=Path)
    parser.argument("--plot", "FILE.png", "plot depth, force, angles and modes (.png, .svg)", type=plot_file)
    parser.argument("--duration", "S", "with --device: simulated time (default: 10)", type=duration)
    parser.argument("--method", None, "rolling method that replaces the scene's")
    parser.argument("--rate", "HZ", "tick rate that replaces the rig's (default: 1000)", type=float)
    parser.argument(
        "--rig",
        None,
        "rig with the force limits and device options (default: replay; with --device simulated-SCENE if it "
        "exists, else simulated)",
    )


def configure_monitor(parser: Parser) -> None:
    parser.description = "Show contact mode, forces, lateness and events of a running server."
    add_daemon_options(parser)
    parser.flag("--once", "print one summary and exit")
    parser.flag("--json", "print one JSON object per line")
    add_stream_options(parser)


def configure_view(parser: Parser) -> None:
    parser.description = (
        "Open a browser page that shows a recording, or a running daemon whose simulated hand the mouse can move."
    )
    parser.argument(
        "recording", "RECORDING", "MCAP file, results, poses, or the name of a shipped recording", nargs="?"
    )
    parser.argument("--scene", None, "scene for a recording; replaces the recorded one")
    parser.argument("--tick", "N", "first tick of the recording to show", type=int, default=0)
    add_daemon_options(parser, commands=True)
    parser.argument(
        "--role",
        None,
        "role of the user: a watcher changes nothing, a participant sees only prompts",
        choices=[role.value for role in Role],
        default=Role.OPERATOR.value,
    )
    parser.argument("--host", None, "address to serve the page on", default=PAGE_HOST)
    parser.argument(
        "--allow-host",
        "NAME[:PORT]",
        "additional host name of the page, such as that of a tunnel or proxy; repeatable",
        action="append",
        default=[],
    )
    parser.argument("--port", None, "port of the page; the next free port if it is in use", type=int, default=PAGE_PORT)
    parser.flag("--print-address", "print only the address, for use by programs")
    # For `run --view`. The first line of standard input is the token, or empty for a new one; end of input ends the
    # page.
    parser.flag("--until-eof", argparse.SUPPRESS)
    parser.flag("--no-open", "do not open a browser")
    parser.argument("--duration", "S", "exit after S seconds (default: run until Ctrl-C)", type=duration)


def configure_record(parser: Parser) -> None:
    parser.description = "Record a running daemon: all telemetry to .mcap, or only poses to .csv."
    parser.argument("file", "FILE", "new file: .mcap for ticks, events and scene; .csv for poses", nargs="?")
    parser.argument(
        "--poses",
        "FILE",
        ".csv for poses, .mcap for all telemetry; NAME=FILE for each of several fingers",
        action="append",
    )
    add_daemon_options(parser, commands=True)
    add_stream_options(parser)


def configure_ctl(parser: Parser) -> None:
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
    parser.argument("method", "METHOD", "one of the methods below")
    parser.argument(
        "params", "key=value", "parameters of the method; values in TOML or JSON, otherwise text", nargs="*"
    )
    add_daemon_options(parser)
    parser.argument("--timeout", "S", "time limit for the answer (default: depends on the method)", type=duration)
    parser.flag("--json", "print the result as JSON")


def configure_scenes(parser: Parser) -> None:
    parser.flag("--json", "print names, files and descriptions as JSON")


configure_rigs = configure_recordings = configure_faults = configure_experiments = configure_scenes


def configure_materials(parser: Parser) -> None:
    parser.description = (
        'List the materials (material = "rubber") and fingertips (fingertip = "human-index") that a scene can use.'
    )
    parser.argument("name", "NAME", "show the values, ranges and sources of this one", nargs="?")
    parser.argument("--plot", "FILE", "plot it with published measurements (.png, .svg)", type=plot_file)
    parser.flag("--json", "print as JSON")


def configure_check(parser: Parser) -> None:
    parser.description = "Validate scenes, rigs and experiments. Exit code 0: all are valid; 2: at least one is not."
    parser.argument("files", "FILE", "scene, rig or experiment: a file or the name of a shipped one", nargs="+")
    parser.flag("--explain", "compile each scene and measure the cost of a tick and of its parts")
    parser.argument(
        "--plot", "FILE.png", "plot the workspace limit of a rig with the objects of a scene", type=plot_file
    )
    parser.flag("--json", "print the findings as JSON")


def configure_schema(parser: Parser) -> None:
    parser.description = (
        "Print the JSON Schema of scenes, rigs, experiments and commands, and the fields of telemetry records."
    )
    parser.argument("kind", None, "schema to print (default: all, as one object)", nargs="?", choices=SCHEMAS)
    parser.flag("--markdown", "print tables of the keys as Markdown")


def configure_warmup(parser: Parser) -> None:
    parser.argument("scenes", "SCENE", "scenes to compile (default: all shipped ones)", nargs="*")
    parser.flag("--prune", "first remove compiled kernels of other versions")
