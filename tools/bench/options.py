"""`softfinger bench`: its measurements and their options; `run` imports the module of the chosen one."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Final

from softfinger.server.arguments import add_flag, add_option, within
from softfinger.tools.bench.geoms import GEOMS_MAX
from softfinger.tools.options import SECONDS, add_output_options


def configure_step(parser: argparse.ArgumentParser) -> None:
    add_option(parser, "--scene", "scene files or names", default=["paper-plane"], type=str, nargs="*")
    add_flag(parser, "--all", "measure all shipped scenes")
    parser.add_argument(
        "--features",
        nargs="*",
        metavar="PATTERN",
        help="also measure the added cost of each feature of the scene format, or of those that match PATTERN, such as "
        "'torsion*'. Each compiles one or two scenes (2 to 5 s); all take about three minutes the first time",
    )
    add_option(parser, "--blocks", "timed blocks of steps", default=2000, type=within(1))


def configure_closed_loop(parser: argparse.ArgumentParser) -> None:
    add_option(parser, "--scene", "scene whose first surface is at z = 0", default="frictionless-plane")
    add_option(parser, "--blocks", "timed blocks of ticks", default=1000, type=within(1))


def configure_simulate(parser: argparse.ArgumentParser) -> None:
    add_option(parser, "--scene", "scene of one finger", default="paper-plane")
    add_option(parser, "--poses", "recording to repeat", default="press-roll-spin-drag", metavar="P")
    add_option(
        parser, "--ticks", "number of ticks; a file of 600000 has up to 0.9 GB", default=600_000, type=within(1000)
    )
    add_option(parser, "--rounds", "repetitions for each format", default=5, type=within(1))
    parser.add_argument("--folder", type=Path, help="folder for temporary files (default: that of the system)")


def configure_loop(parser: argparse.ArgumentParser) -> None:
    add_option(parser, "--seconds", "duration of each loop", default=15.0, type=within(0.1))
    add_option(parser, "--rate", "ticks per second", default=1000.0, metavar="HZ")
    scene = parser.add_mutually_exclusive_group()
    add_option(scene, "--scene", "scene file or name", default="paper-plane")
    scene.add_argument(
        "--geoms",
        type=within(1, GEOMS_MAX),
        metavar="N",
        help=f"use N bodies with one geom each on a floor and two fingers instead, up to {GEOMS_MAX}",
    )
    add_option(parser, "--realtime", "real-time settings: auto, require or off", default="auto")


def configure_device(parser: argparse.ArgumentParser) -> None:
    add_option(parser, "--rig", "rig file or the name of a shipped one", default="replay")
    add_option(parser, "--seconds", "duration at the rate of the rig", default=5.0, type=within(*SECONDS))


def configure_commands(parser: argparse.ArgumentParser) -> None:
    add_option(parser, "--rate", "set_params per second", default=200.0, metavar="HZ")
    add_option(parser, "--seconds", "duration with commands, and again without", default=60.0, type=within(0.1))
    add_option(parser, "--swaps", "number of set_scene commands", default=100, type=within(1))


def configure_mesh(parser: argparse.ArgumentParser) -> None:
    levels = "balls of 20 x 4^N triangles, N from 1 to 9 (4: 5 120, 7: 327 680, 9: 5.2 million; default: 4 6 7)"
    parser.add_argument("--levels", type=within(1, 9), nargs="+", default=[4, 6, 7], metavar="N", help=levels)
    add_option(
        parser,
        "--fingertip",
        "radii of the fingertip",
        default=[0.01],
        type=within(0.0005, 0.03),
        nargs="+",
        metavar="M",
    )
    add_option(parser, "--ticks", "ticks without a pause", default=20_000, type=within(1000))
    add_option(parser, "--paced", "ticks at 1 kHz", default=2_000, type=within(1000))


def configure_view(parser: argparse.ArgumentParser) -> None:
    add_option(parser, "--viewers", "number of simultaneous viewers", default=10, type=within(1), metavar="N")
    add_option(parser, "--browsers", "number of simultaneous pages in Chromium", default=0, type=within(0), metavar="N")
    add_option(parser, "--seconds", "duration of each measurement", default=20.0)
    add_option(parser, "--rig", "rig file or name", default="simulated")


def configure_soak(parser: argparse.ArgumentParser) -> None:
    add_option(parser, "--minutes", "duration", default=10.0, type=within(0.1, 10_000.0), metavar="N")
    add_option(parser, "--realtime", "real-time settings: auto, require or off", default="auto")


def configure_telemetry(parser: argparse.ArgumentParser) -> None:
    add_option(parser, "--subscribers", "number of subscribing processes", default=8, type=within(1))
    add_option(parser, "--seconds", "duration of each measurement", default=10.0, type=within(0.1))
    add_option(parser, "--rate", "ticks per second", default=1000.0, metavar="HZ")
    add_flag(parser, "--forward", "also measure through `softfinger forward`")
    add_flag(parser, "--keys", "with --forward: use CURVE keys")


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
    from softfinger.server.loop.servo_thread import require_machine_code  # it imports numba

    require_machine_code("a measurement")
    module = importlib.import_module(f"softfinger.tools.bench.{args.kind.replace('-', '_')}")
    code: int = module.run(args)
    return code
