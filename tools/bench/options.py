"""`softfinger bench`: its measurements and their options; `run` imports the module of the chosen one."""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path
from typing import Final

from softfinger.tools.bench.geoms import GEOMS_MAX
from softfinger.tools.options import add_output_options


def configure_step(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scene", nargs="*", default=["paper-plane"], help="scene files or names (%(default)s)")
    parser.add_argument("--all", action="store_true", help="every shipped scene")
    parser.add_argument(
        "--features",
        nargs="*",
        metavar="PATTERN",
        help="also what every feature of the scene format adds to a scene without it, or those whose names match, such "
        "as 'torsion*'; each compiles a scene or two, 2 to 5 s, so all of them take some three minutes the first time",
    )
    parser.add_argument("--blocks", type=int, default=2000, help="timed blocks of steps (default: %(default)s)")
    add_output_options(parser)


def configure_closed_loop(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--scene", default="frictionless-plane", help="scene with its first surface at z = 0 (%(default)s)"
    )
    parser.add_argument("--blocks", type=int, default=1000, help="timed blocks of ticks (default: %(default)s)")
    add_output_options(parser)


def configure_simulate(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--scene", default="paper-plane", help="scene of one finger (default: %(default)s)")
    parser.add_argument(
        "--poses", default="press-roll-spin-drag", metavar="P", help="recording, again and again (default: %(default)s)"
    )
    parser.add_argument(
        "--ticks", type=int, default=600_000, help="length, at 1 kHz; a file of 600000 has up to 0.9 GB (%(default)s)"
    )
    parser.add_argument("--rounds", type=int, default=5, help="turns of each format (default: %(default)s)")
    parser.add_argument("--folder", type=Path, help="where the files are for the moment (the system's for such)")
    add_output_options(parser)


def configure_loop(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=float, default=15.0, help="for each of the loops (default: %(default)s)")
    parser.add_argument("--rate", type=float, default=1000.0, metavar="HZ", help="ticks per second (%(default)s)")
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--scene", default="paper-plane", help="scene file or name (default: %(default)s)")
    what.add_argument(
        "--geoms",
        type=int,
        metavar="N",
        help=f"instead so many bodies on a floor, one geom each, up to {GEOMS_MAX}, and two fingers",
    )
    parser.add_argument("--realtime", default="auto", help="auto, require or off (default: %(default)s)")
    add_output_options(parser)


def configure_device(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rig", default="replay", help="rig file or the name of a shipped one (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=5.0, help="at the rig's rate (default: %(default)s)")
    add_output_options(parser)


def configure_commands(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rate", type=float, default=200.0, metavar="HZ", help="set_params a second (%(default)s)")
    parser.add_argument("--seconds", type=float, default=60.0, help="how long, and how long without (%(default)s)")
    parser.add_argument("--swaps", type=int, default=100, help="how often set_scene (default: %(default)s)")
    add_output_options(parser)


def configure_mesh(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--levels",
        type=int,
        nargs="+",
        default=[4, 6, 7],
        metavar="N",
        help="balls of 20 x 4^N triangles, N from 1 to 9: 4 has 5 120, 7 has 327 680, 9 has 5.2 million (%(default)s)",
    )
    parser.add_argument(
        "--fingertip", type=float, nargs="+", default=[0.01], metavar="M", help="radii, m (%(default)s)"
    )
    parser.add_argument("--ticks", type=int, default=20_000, help="back to back (default: %(default)s)")
    parser.add_argument("--paced", type=int, default=2_000, help="ticks a millisecond apart (default: %(default)s)")
    add_output_options(parser)


def configure_view(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--viewers", type=int, default=10, metavar="N", help="viewers at once (default: %(default)s)")
    parser.add_argument("--browsers", type=int, default=0, metavar="N", help="pages at once in Chromium (%(default)s)")
    parser.add_argument("--seconds", type=float, default=20.0, help="how long to measure each (default: %(default)s)")
    parser.add_argument("--rig", default="simulated", help="rig file or name (default: %(default)s)")
    add_output_options(parser)


def configure_soak(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--minutes", type=float, default=10.0, metavar="N", help="how long (default: %(default)s)")
    parser.add_argument("--realtime", default="auto", help="auto, require or off (default: %(default)s)")
    add_output_options(parser)


def configure_telemetry(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--subscribers", type=int, default=8, help="processes that subscribe (default: %(default)s)")
    parser.add_argument("--seconds", type=float, default=10.0, help="how long to measure each (default: %(default)s)")
    parser.add_argument("--rate", type=float, default=1000.0, metavar="HZ", help="ticks per second (%(default)s)")
    parser.add_argument("--transport", choices=["tcp", "ipc"], default="tcp", help="default: %(default)s")
    parser.add_argument(
        "--busy", action="store_true", help="also with a busy Python thread, in the daemon and next to the C loop"
    )
    parser.add_argument("--forward", action="store_true", help="also through `softfinger forward`")
    parser.add_argument("--keys", action="store_true", help="with --forward: by CURVE keys")
    parser.add_argument("--rig", default="replay", help="rig file or name (default: %(default)s)")
    parser.add_argument("--beside", metavar="PYTHON", help="interpreter of another version; the daemons run in turn")
    add_output_options(parser)


KINDS: Final = {
    "step": ("cost of the contact step, back to back", configure_step),
    "closed-loop": ("ticks per second with a simulated device, offline", configure_closed_loop),
    "simulate": ("how fast `simulate` is, from its start to the file", configure_simulate),
    "loop": ("lateness and execution time of the servo loop, compared with a C loop", configure_loop),
    "device": ("time of an exchange with a device, compared with an empty one", configure_device),
    "commands": ("effect of commands on a pressing hand: torn sets, steps, memory", configure_commands),
    "mesh": ("cost of a tick on a mesh, by its size", configure_mesh),
    "view": ("cost of pages for the servo, and their frame rate", configure_view),
    "soak": ("a long run with all services: growth of memory, missed ticks, lost records", configure_soak),
    "telemetry": ("time from tick to subscriber, and lost records", configure_telemetry),
}
"""Description and options of each measurement, which is `run` in the module of this name."""


def configure_bench(parser: argparse.ArgumentParser) -> None:
    kinds = parser.add_subparsers(dest="kind", metavar="KIND", required=True)
    for name, (text, configure) in KINDS.items():
        description = f"softfinger bench {name}: {text}."
        kinds.add_parser(name, help=text, description=description, configure=configure)


def run(args: argparse.Namespace) -> int:
    """Run the chosen measurement and return its exit code."""
    module = importlib.import_module(f"softfinger.tools.bench.{args.kind.replace('-', '_')}")
    code: int = module.run(args)
    return code
