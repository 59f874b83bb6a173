"""Options of `softfinger accuracy`."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Final, Literal

from softfinger.server.arguments import add_flag, add_option
from softfinger.tools.options import add_output_options, add_sweep_options

SURFACES: Final = (
    "plane", "sphere", "sphere-inside", "cylinder", "cylinder-inside", "capped-cylinder", "capsule", "capsule-inside",
    "box", "ellipsoid", "ellipsoid-inside", "torus", "torus-inside",
)  # fmt: skip
METHODS: Final = ("euler_zxz", "euler_zyx", "rotation_vector", "midpoint", "montana_rk4", "montana_rk45")
Motion = Literal["constant", "changing"]
MOTIONS: Final[tuple[Motion, ...]] = ("constant", "changing")
TARGETS_M: Final = (1e-4, 1e-5, 1e-6, 1e-7, 1e-9, 1e-12)
DRIFT_STEPS: Final = 1_000_000
REPORT: Final = "accuracy.txt"


def configure_accuracy(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--surface", nargs="+", choices=SURFACES, metavar="S", help=f"surfaces: {', '.join(SURFACES)} (default: all)"
    )
    parser.add_argument(
        "--method",
        nargs="+",
        choices=METHODS,
        metavar="M",
        help=f"rolling methods: {', '.join(METHODS)} (default: all)",
    )
    parser.add_argument("--rate", nargs="+", type=float, metavar="HZ", help="servo rates (default: 4 to 8000)")
    targets = "errors (m) to recommend methods for"
    add_option(parser, "--error-below", targets, default=TARGETS_M, nargs="+", type=float, metavar="M")
    parser.add_argument(
        "--drift-steps", type=int, metavar="N", help=f"steps of the drift test (default: {DRIFT_STEPS})"
    )
    instead = parser.add_mutually_exclusive_group()
    add_flag(instead, "--meshes", "compare meshes of a ball, a cylinder and a torus with the exact shapes instead")
    add_flag(instead, "--heightmap", "compare a height map with a mesh of the same pixels instead")
    add_flag(parser, "--quick", "four servo rates, no other sweep, short drift test")
    add_sweep_options(parser)
    add_output_options(parser)
    parser.add_argument("--figures", type=Path, metavar="DIR", help=f"folder for accuracy-*.svg and {REPORT}")
