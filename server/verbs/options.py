"""Options of the verbs in this folder.

Their modules import the compiler or numpy, which takes longer than a help text.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, Final

from softfinger.server.arguments import (
    Parser,
    add_daemon_options,
    add_duration,
    add_flag,
    add_option,
    add_stream_options,
)
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
    add_option(
        parser,
        "--rig",
        f"rig file or the name of a shipped one (default: simulated-SCENE if it exists, else {RIG}; with --view "
        f"{VIEW_RIG})",
    )
    add_option(parser, "--scene", "scene file or name", default="paper-plane")
    for flag, _, kind, metavar, text in OVERRIDES:
        add_option(parser, flag, text, metavar=metavar, type=kind)
    add_flag(parser, "--once", "play a recording once instead of looping it")
    add_flag(
        parser, "--watcher", "require, for each device, a second process that removes the force if this one is killed"
    )
    add_option(parser, "--record", "record every tick and event to a new .mcap file", metavar="FILE")
    add_option(
        parser, "--inject", "inject faults between device and loop: a file or the name of a shipped one", metavar="FILE"
    )
    add_flag(parser, "--view", "open a browser page on which the mouse moves the hand")
    add_duration(parser, "--duration", "stop after S seconds of ticks")


def configure_simulate(parser: Parser) -> None:
    add_option(parser, "--scene", "scene file or name", default="paper-plane")
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
    add_option(parser, "--out", "output file: .csv, .npz or .mcap", required=True, type=Path)
    add_option(parser, "--plot", "plot depth, force, angles and modes (.png, .svg)", metavar="FILE.png", type=plot_file)
    add_duration(parser, "--duration", "with --device: simulated time (default: 10)")
    add_option(parser, "--method", "rolling method that replaces the scene's")
    add_option(parser, "--rate", "tick rate that replaces the rig's (default: 1000)", metavar="HZ", type=float)
    add_option(
        parser,
        "--rig",
        "rig with the force limits and device options (default: replay; with --device simulated-SCENE if it "
        "exists, else simulated)",
    )


def configure_monitor(parser: Parser) -> None:
    parser.description = "Show contact mode, forces, lateness and events of a running server."
    add_daemon_options(parser)
    add_flag(parser, "--once", "print one summary and exit")
    add_flag(parser, "--json", "print one JSON object per line")
    add_stream_options(parser)


def configure_view(parser: Parser) -> None:
    parser.description = (
        "Open a browser page that shows a recording, or a running daemon whose simulated hand the mouse can move."
    )
    add_option(
        parser,
        "recording",
        "MCAP file, results, poses, or the name of a shipped recording",
        metavar="RECORDING",
        nargs="?",
    )
    add_option(parser, "--scene", "scene for a recording; replaces the recorded one")
    add_option(parser, "--tick", "first tick of the recording to show", default=0, metavar="N")
    add_daemon_options(parser, commands=True)
    add_option(
        parser,
        "--role",
        "role of the user: a watcher changes nothing, a participant sees only prompts",
        default=Role.OPERATOR.value,
        choices=[role.value for role in Role],
    )
    add_option(parser, "--host", "address to serve the page on", default=PAGE_HOST)
    add_option(
        parser,
        "--allow-host",
        "additional host name of the page, such as that of a tunnel or proxy; repeatable",
        default=[],
        metavar="NAME[:PORT]",
        action="append",
    )
    add_option(parser, "--port", "port of the page; the next free port if it is in use", default=PAGE_PORT)
    add_flag(parser, "--print-address", "print only the address, for use by programs")
    # For `run --view`. The first line of standard input is the token, or empty for a new one; end of input ends the
    # page.
    add_flag(parser, "--until-eof", argparse.SUPPRESS)
    add_flag(parser, "--no-open", "do not open a browser")
    add_duration(parser, "--duration", "exit after S seconds (default: run until Ctrl-C)")


def configure_record(parser: Parser) -> None:
    parser.description = "Record a running daemon: all telemetry to .mcap, or only poses to .csv."
    add_option(parser, "file", "new file: .mcap for ticks, events and scene; .csv for poses", metavar="FILE", nargs="?")
    add_option(
        parser,
        "--poses",
        ".csv for poses, .mcap for all telemetry; NAME=FILE for each of several fingers",
        metavar="FILE",
        action="append",
    )
    add_daemon_options(parser, commands=True)
    add_stream_options(parser)


def configure_ctl(parser: Parser) -> None:
    from softfinger.server.wire.commands import METHODS, make_table

    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    width = max(map(len, METHODS))
    methods = "\n".join(
        f"  {name:{width}}  {meaning}{f' ({params})' if params else ''}"
        for name, (params, _, meaning) in make_table().items()
    )
    parser.epilog = (
        f"methods:\n{methods}\n\n"
        "examples:\n"
        "  softfinger ctl get_state\n"
        "  softfinger ctl set_params object.table.material.stiffness_n_per_m=800\n"
        "  softfinger ctl set_scene scene=sphere          # or a file: scene=mine.toml\n"
        "  softfinger ctl drive object=lid 'position_m=[0, 0, 0.01]'"
    )
    add_option(parser, "method", "one of the methods below", metavar="METHOD")
    add_option(
        parser,
        "params",
        "parameters of the method; values in TOML or JSON, otherwise text",
        metavar="key=value",
        nargs="*",
    )
    add_daemon_options(parser)
    add_duration(parser, "--timeout", "time limit for the answer (default: depends on the method)")
    add_flag(parser, "--json", "print the result as JSON")


def configure_scenes(parser: Parser) -> None:
    add_flag(parser, "--json", "print names, files and descriptions as JSON")


configure_rigs = configure_recordings = configure_faults = configure_experiments = configure_scenes


def configure_materials(parser: Parser) -> None:
    parser.description = (
        'List the materials (material = "rubber") and fingertips (fingertip = "human-index") that a scene can use.'
    )
    add_option(parser, "name", "show the values, ranges and sources of this one", metavar="NAME", nargs="?")
    add_option(parser, "--plot", "plot it with published measurements (.png, .svg)", metavar="FILE", type=plot_file)
    add_flag(parser, "--json", "print as JSON")


def configure_check(parser: Parser) -> None:
    parser.description = "Validate scenes, rigs and experiments. Exit code 0: all are valid; 2: at least one is not."
    add_option(
        parser, "files", "scene, rig or experiment: a file or the name of a shipped one", metavar="FILE", nargs="+"
    )
    add_flag(parser, "--explain", "compile each scene and measure the cost of a tick and of its parts")
    add_option(
        parser,
        "--plot",
        "plot the workspace limit of a rig with the objects of a scene",
        metavar="FILE.png",
        type=plot_file,
    )
    add_flag(parser, "--json", "print the findings as JSON")


def configure_schema(parser: Parser) -> None:
    parser.description = (
        "Print the JSON Schema of scenes, rigs, experiments and commands, and the fields of telemetry records."
    )
    add_option(parser, "kind", "schema to print (default: all, as one object)", nargs="?", choices=SCHEMAS)
    add_flag(parser, "--markdown", "print tables of the keys as Markdown")


def configure_warmup(parser: Parser) -> None:
    add_option(parser, "scenes", "scenes to compile (default: all shipped ones)", metavar="SCENE", nargs="*")
    add_flag(parser, "--prune", "first remove compiled kernels of other versions")
