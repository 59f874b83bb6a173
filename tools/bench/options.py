"""`softfinger bench`: its measurements and their options; `run` imports the module of the chosen one."""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path
from typing import Final

from softfinger.tools.bench.geoms import GEOMS_MAX
from softfinger.tools.options import add_output_options


def configure_step(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--scene", nargs="*", default=["paper-plane"], help="scene files or names (default: %(default)s)"
    )
    parser.add_argument("--all", action="store_true", help="measure all shipped scenes")
    parser.add_argument(
        "--features",
        nargs="*",
        metavar="PATTERN",
        help="also measure the added cost of each feature of the scene format, or of those that match PATTERN, such as "
        "'torsion*'. Each compiles one or two scenes (2 to 5 s); all take about three minutes the first time",
    )
    parser.add_argument("--blocks", type=int, default=2000, help="timed blocks of steps (default: %(default)s)")
    add_output_options(parser)


def configure_closed_loop(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--scene", default="frictionless-plane", help="scene whose first surface is at z = 0 (default: %(default)s)"
    )
    parser.add_argument("--blocks", type=int, default=1000, help="timed blocks of ticks (default: %(default)s)")
    add_output_options(parser)


def configure_simulate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scene", default="paper-plane", help="scene of one finger (default: %(default)s)")
    parser.add_argument(
        "--poses", default="press-roll-spin-drag", metavar="P", help="recording to repeat (default: %(default)s)"
    )
    parser.add_argument(
        "--ticks",
        type=int,
        default=600_000,
        help="number of ticks; a file of 600000 has up to 0.9 GB (default: %(default)s)",
    )
    parser.add_argument("--rounds", type=int, default=5, help="repetitions for each format (default: %(default)s)")
    parser.add_argument("--folder", type=Path, help="folder for temporary files (default: that of the system)")
    add_output_options(parser)


def configure_loop(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=float, default=15.0, help="duration of each loop (default: %(default)s)")
    parser.add_argument(
        "--rate", type=float, default=1000.0, metavar="HZ", help="ticks per second (default: %(default)s)"
    )
    scene = parser.add_mutually_exclusive_group()
    scene.add_argument("--scene", default="paper-plane", help="scene file or name (default: %(default)s)")
    scene.add_argument(
        "--geoms",
        type=int,
        metavar="N",
        help=f"use N bodies with one geom each on a floor and two fingers instead, up to {GEOMS_MAX}",
    )
    parser.add_argument(
        "--realtime", default="auto", help="real-time settings: auto, require or off (default: %(default)s)"
    )
    add_output_options(parser)


def configure_device(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rig", default="replay", help="rig file or the name of a shipped one (default: %(default)s)")
    parser.add_argument(
        "--seconds", type=float, default=5.0, help="duration at the rate of the rig (default: %(default)s)"
    )
    add_output_options(parser)


def configure_commands(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--rate", type=float, default=200.0, metavar="HZ", help="set_params per second (default: %(default)s)"
    )
    parser.add_argument(
        "--seconds", type=float, default=60.0, help="duration with commands, and again without (default: %(default)s)"
    )
    parser.add_argument("--swaps", type=int, default=100, help="number of set_scene commands (default: %(default)s)")
    add_output_options(parser)


def configure_mesh(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--levels",
        type=int,
        nargs="+",
        default=[4, 6, 7],
        metavar="N",
        help="balls of 20 x 4^N triangles, N from 1 to 9 (4: 5 120, 7: 327 680, 9: 5.2 million; default: %(default)s)",
    )
    parser.add_argument(
        "--fingertip",
        type=float,
        nargs="+",
        default=[0.01],
        metavar="M",
        help="radii of the fingertip (default: %(default)s)",
    )
    parser.add_argument("--ticks", type=int, default=20_000, help="ticks without a pause (default: %(default)s)")
    parser.add_argument("--paced", type=int, default=2_000, help="ticks at 1 kHz (default: %(default)s)")
    add_output_options(parser)


def configure_view(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--viewers", type=int, default=10, metavar="N", help="number of simultaneous viewers (default: %(default)s)"
    )
    parser.add_argument(
        "--browsers",
        type=int,
        default=0,
        metavar="N",
        help="number of simultaneous pages in Chromium (default: %(default)s)",
    )
    parser.add_argument(
        "--seconds", type=float, default=20.0, help="duration of each measurement (default: %(default)s)"
    )
    parser.add_argument("--rig", default="simulated", help="rig file or name (default: %(default)s)")
    add_output_options(parser)


def configure_soak(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--minutes", type=float, default=10.0, metavar="N", help="duration (default: %(default)s)")
    parser.add_argument(
        "--realtime", default="auto", help="real-time settings: auto, require or off (default: %(default)s)"
    )
    add_output_options(parser)


def configure_telemetry(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--subscribers", type=int, default=8, help="number of subscribing processes (default: %(default)s)"
    )
    parser.add_argument(
        "--seconds", type=float, default=10.0, help="duration of each measurement (default: %(default)s)"
    )
    parser.add_argument(
        "--rate", type=float, default=1000.0, metavar="HZ", help="ticks per second (default: %(default)s)"
    )
    parser.add_argument("--forward", action="store_true", help="also measure through `softfinger forward`")
    parser.add_argument("--keys", action="store_true", help="with --forward: use CURVE keys")
    add_output_options(parser)


KINDS: Final = {
    "step": ("cost of the contact step without pauses", configure_step),
    "closed-loop": ("ticks per second with a simulated device, offline", configure_closed_loop),
    "simulate": ("speed of `simulate`, from start to finished file", configure_simulate),
    "loop": ("lateness and execution time of the servo loop, compared with a C loop", configure_loop),
    "device": ("duration of an exchange with a device, compared with an empty one", configure_device),
    "commands": ("effect of commands on the rendered force and on memory", configure_commands),
    "mesh": ("cost of a tick on meshes of different sizes", configure_mesh),
    "view": ("cost of browser pages for the servo, and their frame rate", configure_view),
    "soak": ("long run with all services: memory growth, missed ticks, lost records", configure_soak),
    "telemetry": ("latency from tick to subscriber, and lost records", configure_telemetry),
}
"""Description and options of each measurement, which is `run` in the module of this name."""


def configure_bench(parser: argparse.ArgumentParser) -> None:
    kinds = parser.add_subparsers(dest="kind", metavar="KIND", required=True)
    for name, (text, configure) in KINDS.items():
        description = f"Measure: {text}."
        kinds.add_parser(name, help=text, description=description, configure=configure)


def run(args: argparse.Namespace) -> int:
    """Run the chosen measurement and return its exit code."""
    module = importlib.import_module(f"softfinger.tools.bench.{args.kind.replace('-', '_')}")
    code: int = module.run(args)
    return code
