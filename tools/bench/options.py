"""`softfinger bench`: its measurements and their options; `run` imports the module of the chosen one."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

from softfinger.tools.bench.geoms import GEOMS_MAX
from softfinger.tools.options import add_option, add_output_options


def configure_step(parser: argparse.ArgumentParser) -> None:
    add_option(parser, "--scene", ["paper-plane"], "scene files or names", type=str, nargs="*")
    parser.add_argument("--all", action="store_true", help="measure all shipped scenes")
    parser.add_argument(
        "--features",
        nargs="*",
        metavar="PATTERN",
        help="also measure the added cost of each feature of the scene format, or of those that match PATTERN, such as "
        "'torsion*'. Each compiles one or two scenes (2 to 5 s); all take about three minutes the first time",
    )
    add_option(parser, "--blocks", 2000, "timed blocks of steps")


def configure_closed_loop(parser: argparse.ArgumentParser) -> None:
    add_option(parser, "--scene", "frictionless-plane", "scene whose first surface is at z = 0")
    add_option(parser, "--blocks", 1000, "timed blocks of ticks")


def configure_simulate(parser: argparse.ArgumentParser) -> None:
    add_option(parser, "--scene", "paper-plane", "scene of one finger")
    add_option(parser, "--poses", "press-roll-spin-drag", "recording to repeat", metavar="P")
    add_option(parser, "--ticks", 600_000, "number of ticks; a file of 600000 has up to 0.9 GB")
    add_option(parser, "--rounds", 5, "repetitions for each format")
    parser.add_argument("--folder", type=Path, help="folder for temporary files (default: that of the system)")


def configure_loop(parser: argparse.ArgumentParser) -> None:
    add_option(parser, "--seconds", 15.0, "duration of each loop")
    add_option(parser, "--rate", 1000.0, "ticks per second", metavar="HZ")
    scene = parser.add_mutually_exclusive_group()
    add_option(scene, "--scene", "paper-plane", "scene file or name")
    scene.add_argument(
        "--geoms",
        type=int,
        metavar="N",
        help=f"use N bodies with one geom each on a floor and two fingers instead, up to {GEOMS_MAX}",
    )
    add_option(parser, "--realtime", "auto", "real-time settings: auto, require or off")


def configure_device(parser: argparse.ArgumentParser) -> None:
    add_option(parser, "--rig", "replay", "rig file or the name of a shipped one")
    add_option(parser, "--seconds", 5.0, "duration at the rate of the rig")


def configure_commands(parser: argparse.ArgumentParser) -> None:
    add_option(parser, "--rate", 200.0, "set_params per second", metavar="HZ")
    add_option(parser, "--seconds", 60.0, "duration with commands, and again without")
    add_option(parser, "--swaps", 100, "number of set_scene commands")


def configure_mesh(parser: argparse.ArgumentParser) -> None:
    levels = "balls of 20 x 4^N triangles, N from 1 to 9 (4: 5 120, 7: 327 680, 9: 5.2 million; default: %(default)s)"
    parser.add_argument("--levels", type=int, nargs="+", default=[4, 6, 7], metavar="N", help=levels)
    add_option(parser, "--fingertip", [0.01], "radii of the fingertip", type=float, nargs="+", metavar="M")
    add_option(parser, "--ticks", 20_000, "ticks without a pause")
    add_option(parser, "--paced", 2_000, "ticks at 1 kHz")


def configure_view(parser: argparse.ArgumentParser) -> None:
    add_option(parser, "--viewers", 10, "number of simultaneous viewers", metavar="N")
    add_option(parser, "--browsers", 0, "number of simultaneous pages in Chromium", metavar="N")
    add_option(parser, "--seconds", 20.0, "duration of each measurement")
    add_option(parser, "--rig", "simulated", "rig file or name")


def configure_soak(parser: argparse.ArgumentParser) -> None:
    add_option(parser, "--minutes", 10.0, "duration", metavar="N")
    add_option(parser, "--realtime", "auto", "real-time settings: auto, require or off")


def configure_telemetry(parser: argparse.ArgumentParser) -> None:
    add_option(parser, "--subscribers", 8, "number of subscribing processes")
    add_option(parser, "--seconds", 10.0, "duration of each measurement")
    add_option(parser, "--rate", 1000.0, "ticks per second", metavar="HZ")
    parser.add_argument("--forward", action="store_true", help="also measure through `softfinger forward`")
    parser.add_argument("--keys", action="store_true", help="with --forward: use CURVE keys")


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
    for name, (text, add_own_options) in KINDS.items():
        configure = partial(_configure_kind, add_own_options)
        kinds.add_parser(name, help=text, description=f"Measure: {text}.", configure=configure)


def _configure_kind(add_own_options: Callable[[argparse.ArgumentParser], None], kind: argparse.ArgumentParser) -> None:
    add_own_options(kind)
    add_output_options(kind)


def run(args: argparse.Namespace) -> int:
    module = importlib.import_module(f"softfinger.tools.bench.{args.kind.replace('-', '_')}")
    code: int = module.run(args)
    return code
