"""Options of the verbs in this folder.

Their modules import the compiler or numpy, which takes longer than a help text.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any, Final

from softfinger.server.arguments import add_endpoint_option, add_key_options, duration
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
    ("--device", "device.driver", str, "D", "driver, in place of the rig's"),
    ("--recording", "device.recording", str, "P", "poses to replay: file or name of a shipped recording"),
    ("--forces", "device.forces", str, "FILE", "file for the forces that a replay writes: .csv or .npz"),
    ("--rate", "servo.rate_hz", float, "HZ", "ticks per second, 100 to 8000"),
    ("--realtime", "servo.realtime", str, "MODE", "auto, require or off"),
    ("--endpoint", "telemetry.endpoint", str, "URL", "where telemetry is published"),
    ("--commands", "commands.endpoint", str, "URL", "where commands are taken; off: none are"),
    ("--metrics", "metrics.endpoint", "127.0.0.1:{}".format, "PORT", "figures for Prometheus; 0: a free port"),
)


def configure_run(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--rig",
        help=f"rig file or the name of a shipped one (default: simulated-SCENE where there is one, else {RIG}, with "
        f"--view {VIEW_RIG})",
    )
    parser.add_argument("--scene", default="paper-plane", help="scene file or name (default: %(default)s)")
    for flag, _, kind, metavar, text in OVERRIDES:
        parser.add_argument(flag, type=kind, metavar=metavar, help=text)
    parser.add_argument("--once", action="store_true", help="play a recording once instead of looping it")
    parser.add_argument(
        "--watcher", action="store_true", help="a small process that takes the force off if this one is killed"
    )
    parser.add_argument("--record", metavar="FILE", help="record every tick and event into a new .mcap file")
    parser.add_argument("--inject", metavar="FILE", help="faults injected between device and loop: file or name")
    parser.add_argument("--view", action="store_true", help="open a page in the browser, with a mouse for a hand")
    parser.add_argument("--duration", type=duration, metavar="S", help="stop after so many seconds of ticks")


def configure_simulate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scene", default="paper-plane", help="scene file or name (default: %(default)s)")
    poses_or_device = parser.add_mutually_exclusive_group(required=True)
    poses_or_device.add_argument(
        "--poses",
        action="append",
        metavar="P",
        help="CSV, npz or MCAP file, or a shipped recording; of several fingers an MCAP of all, or NAME=P for each",
    )
    poses_or_device.add_argument(
        "--device", metavar="D", help="devices that are computed: simulated; they feel the force"
    )
    parser.add_argument("--out", required=True, type=Path, help="where to: .csv, .npz or .mcap")
    parser.add_argument(
        "--plot", type=plot_file, metavar="FILE.png", help="draw depth, force, angles and modes (.png, .svg)"
    )
    parser.add_argument("--duration", type=duration, metavar="S", help="with --device: how long (10)")
    parser.add_argument("--method", help="rolling method in place of the scene's")
    parser.add_argument("--rate", type=float, metavar="HZ", help="tick rate in place of the rig's (1000)")
    parser.add_argument(
        "--rig",
        help="rig with the guard and the options of the device (replay; with --device "
        "simulated-SCENE, or simulated if there is none)",
    )


def configure_monitor(parser: argparse.ArgumentParser) -> None:
    parser.description = "Show contact mode, forces, lateness and events of a running server."
    add_endpoint_option(parser)
    add_key_options(parser)
    parser.add_argument("--once", action="store_true", help="show one summary and leave")
    parser.add_argument("--json", action="store_true", help="write JSON objects, one a line")
    parser.add_argument("--duration", type=float, metavar="S", help="leave after S seconds (default: stay)")
    parser.add_argument(
        "--timeout", type=float, metavar="S", default=3.0, help="fail if nothing arrives for S seconds at the start"
    )


def configure_view(parser: argparse.ArgumentParser) -> None:
    parser.description = "Open a page in the browser that shows a running daemon, with a mouse as hand; or a recording."
    parser.add_argument(
        "recording", nargs="?", metavar="RECORDING", help="an .mcap, results, poses, or the name of a shipped recording"
    )
    parser.add_argument("--scene", help="scene of a recording without one, or instead of it")
    parser.add_argument("--tick", type=int, default=0, metavar="N", help="where in a recording to begin")
    add_endpoint_option(parser)
    parser.add_argument("--commands", help="commands endpoint (default: next to that of telemetry)")
    add_key_options(parser)
    parser.add_argument(
        "--role",
        choices=[each.value for each in Role],
        default=Role.OPERATOR.value,
        help="role of the user: a watcher changes nothing, a participant sees only prompts (%(default)s)",
    )
    parser.add_argument("--host", default=PAGE_HOST, help="address that the page is served on (%(default)s)")
    parser.add_argument(
        "--allow-host",
        action="append",
        default=[],
        metavar="NAME[:PORT]",
        help="another name that a browser may call the page by, behind a tunnel or proxy; may be repeated",
    )
    parser.add_argument("--port", type=int, default=PAGE_PORT, help="of the page, or the next free one (%(default)s)")
    parser.add_argument(
        "--print-address", action="store_true", help="only the address on standard output, for programs"
    )
    # For `run --view`. The first line of standard input is the token, or empty for a new one; end of input ends the
    # page.
    parser.add_argument("--until-eof", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--no-open", action="store_true", help="do not open a browser")
    parser.add_argument("--duration", type=duration, metavar="S", help="leave after S seconds (default: stay)")


def configure_record(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Record a running server: all values as .mcap, or only the poses as .csv, by the file's suffix."
    )
    parser.add_argument("file", nargs="?", metavar="FILE", help="a new .mcap with ticks, events and scene; .csv: poses")
    parser.add_argument(
        "--poses",
        action="append",
        metavar="FILE",
        help=".csv: only poses; .mcap: every value of every tick; NAME=FILE for each of several fingers",
    )
    add_endpoint_option(parser)
    parser.add_argument(
        "--commands", metavar="URL", help="endpoint of the server's description (default: next to that of telemetry)"
    )
    add_key_options(parser)
    parser.add_argument(
        "--duration", type=float, metavar="S", help="stop after S seconds (default: at the server's end)"
    )
    parser.add_argument(
        "--timeout", type=float, metavar="S", default=3.0, help="end when nothing arrives for S seconds (default: 3)"
    )


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
    parser.add_argument("method", metavar="METHOD", help="method: one of the list below")
    parser.add_argument(
        "params", nargs="*", metavar="key=value", help="its parameters: values of TOML or JSON, else texts"
    )
    add_endpoint_option(parser)
    add_key_options(parser)
    parser.add_argument(
        "--timeout", type=duration, metavar="S", help="longest wait for the answer (default: by method)"
    )
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def configure_scenes(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--json", action="store_true", help="print name, file and description as JSON")


configure_rigs = configure_recordings = configure_faults = configure_experiments = configure_scenes


def configure_materials(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        'The materials that a scene may name (material = "rubber") and the fingertips (fingertip = "human-index").'
    )
    parser.add_argument("name", nargs="?", metavar="NAME", help="one of them, with its values, its range and sources")
    parser.add_argument(
        "--plot", type=plot_file, metavar="FILE", help="draw it with published measurements (.png, .svg)"
    )
    parser.add_argument("--json", action="store_true", help="print as JSON")


def configure_check(parser: argparse.ArgumentParser) -> None:
    parser.description = "Check scenes, rigs and experiments. Exit code 0: all are usable; 2: at least one is not."
    parser.add_argument("files", nargs="+", metavar="FILE", help="one of these, as a file or a shipped name")
    parser.add_argument(
        "--explain",
        action="store_true",
        help="compile each scene and measure the cost of a tick and of each part of it",
    )
    parser.add_argument(
        "--plot",
        type=plot_file,
        metavar="FILE.png",
        help="draw the soft wall of a rig about the objects of a scene, and the arc or plane of its device",
    )
    parser.add_argument("--json", action="store_true", help="print the findings as JSON")


def configure_schema(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Print the JSON Schema of scenes, rigs, experiments and commands, and the fields of a telemetry record."
    )
    parser.add_argument("kind", nargs="?", choices=SCHEMAS, help="which schema (default: all, in one object)")
    parser.add_argument("--markdown", action="store_true", help="print tables of the keys instead, for people")


def configure_warmup(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("scenes", nargs="*", metavar="SCENE", help="scenes to compile for (default: all shipped ones)")
    parser.add_argument("--prune", action="store_true", help="remove the kernels of other versions first")
