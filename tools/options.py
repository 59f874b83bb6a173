"""Options of the verbs in this folder and below, except `bench`, and those that several measurements have.

The modules of the verbs import the code that they measure, which would delay a help text.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Annotated, Final, Literal, get_args, get_type_hints

import msgspec
from msgspec import Meta

from softfinger.config import limits
from softfinger.config.fields import find_unit
from softfinger.server.arguments import add_flag, add_option, within
from softfinger.server.offline.figures import plot_file

PUSH_N: Final = 0.2
"""Amplitude of the pushes: a tenth of the force of most devices, and more than the friction of a good one."""
SECONDS: Final = limits.Range(0.1, 60.0, "a row of every tick is stored in memory")
"""Limits of the duration of a measured exchange."""


def add_output_options(parser: argparse.ArgumentParser) -> None:
    add_flag(parser, "--json", "print the result as JSON")
    parser.add_argument("--plot", type=plot_file, metavar="FILE.png", help="plot the result (.png, .svg; extra plots)")


def add_sweep_options(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("computation and storage")
    group.add_argument(
        "--scheduler", metavar="ADDRESS", help="address of a dask scheduler, or 'local' for local processes"
    )
    group.add_argument(
        "--results", type=Path, metavar="FILE.mcap", help="file for finished cases; a second run continues there"
    )


def configure_devices(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "List attached devices with their driver. For a device that cannot be opened, show the reason and the command "
        "that fixes it. Devices are opened only with --ask or --probe."
    )
    add_flag(parser, "--json", "print the result as JSON")
    add_flag(parser, "--ask", "open each free device and read its data")
    parser.add_argument(
        "--rig",
        help="rig that names the library or firmware file of its driver; with --ask, the vendor's library or service "
        "is queried even if no device is listed on USB",
    )
    parser.add_argument(
        "--probe",
        nargs="?",
        const="",
        metavar="FILE",
        help="open the rig's device (default: the first attached one) for ten seconds at zero force; show rate, range, "
        "noise, buttons and axes, and write a report (default: softfinger-DRIVER-report.json)",
    )
    add_flag(
        parser,
        "--push",
        f"with --probe: then apply {PUSH_N:g} N in both directions of each axis and ask for the felt direction. "
        "THE HANDLE MOVES: hold it lightly",
    )


def configure_report(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Write an archive for a bug report: versions, output of doctor, rig, scene, and the latest black box files "
        "with their log. Names of the user and the machine, folders and serial numbers are removed. Check the "
        "archive before you send it."
    )
    add_option(parser, "--rig", "rig file or name", default="replay")
    add_option(parser, "--scene", "scene file or name", default="paper-plane")
    add_option(parser, "--out", "archive", default=Path("softfinger-report.tar.gz"), type=Path, metavar="FILE")
    add_option(parser, "--boxes", "number of black boxes, latest first", default=3, type=within(0), metavar="N")
    add_option(parser, "--seconds", "duration of each measurement of doctor", default=1.0, type=within(*SECONDS))


def configure_calibrate(parser: argparse.ArgumentParser) -> None:
    add_option(parser, "--rig", "rig file of a Falcon, or the name of a shipped one", default="falcon", metavar="FILE")
    mass = within(0.02, 0.4, "use another weight")
    add_option(parser, "--mass", "mass of the weight, 0.02 to 0.4", type=mass, required=True, metavar="KG")
    add_option(parser, "--hang", "time to attach the weight", default=60.0, metavar="S")
    add_output_options(parser)


def configure_doctor(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Check whether this machine can run the daemon: hardware, permissions, timing of the servo loop. Exit code 0 "
        "if no problem is found. With --device-report, write a report on the device of a rig for a bug report."
    )
    add_option(parser, "--rig", "rig file or the name of a shipped one", default="replay")
    add_option(parser, "--scene", "scene whose step is timed", default="paper-plane")
    add_option(parser, "--seconds", "duration of each measurement", default=3.0, type=within(*SECONDS))
    add_output_options(parser)
    parser.add_argument(
        "--device-report",
        nargs="?",
        const="",
        metavar="FILE",
        help="open the rig's device and write a JSON report (default: softfinger-DRIVER-report.json). Only zero "
        "force is sent. Prompts in the terminal request movements of the handle",
    )
    parser.add_argument(
        "--with-force",
        type=float,
        metavar="N",
        help="also apply a force: a slow sine of at most N newtons along x, y and z in turn, within the limits of "
        "rig and device. THE HANDLE MOVES: hold it lightly, and start with 1",
    )
    add_flag(parser, "--no-prompts", "do not prompt, even in a terminal")


MAPS: Final = ("zwidth", "rate", "delay")
POINTS: Final = 24
FLAGS: Final = {
    "mass": "mass_kg",
    "damping": "damping_ns_per_m",
    "wall-damping": "wall_damping_ns_per_m",
    "rate": "rate_hz",
    "delay": "delay_ticks",
    "hand-mass": "hand_mass_kg",
    "hand-damping": "hand_damping_ns_per_m",
    "hand-stiffness": "hand_stiffness_n_per_m",
    "friction": "friction_n",
    "resolution": "resolution_m",
    "velocity-filter": "velocity_time_constant_s",
    "passivity-damping": "passivity_damping_ns_per_m",
}
"""Command-line flag of each field of a case."""


class CaseOptions(msgspec.Struct, frozen=True, kw_only=True):
    """Wall, device and hand along one axis."""

    mass_kg: Annotated[float, Meta(ge=1e-3, le=100.0, description="apparent mass of the device")] = 0.2
    damping_ns_per_m: Annotated[float, Meta(ge=0.0, le=1e3, description="physical damping of the device")] = 2.0
    wall_damping_ns_per_m: Annotated[
        float, Meta(ge=0.0, le=limits.DAMPING_NS_PER_M.high, description="damping of the wall")
    ] = 0.0
    rate_hz: Annotated[float, Meta(ge=50.0, le=50e3, description="ticks per second")] = 1000.0
    delay_ticks: Annotated[int, Meta(ge=0, le=16, description="ticks from measurement to force")] = 0
    hand_mass_kg: Annotated[float, Meta(ge=0.0, le=100.0, description="mass of the gripping hand")] = 0.0
    hand_damping_ns_per_m: Annotated[float, Meta(ge=0.0, le=1e3, description="damping of the hand")] = 0.0
    hand_stiffness_n_per_m: Annotated[float, Meta(ge=0.0, le=1e5, description="stiffness of the hand")] = 0.0
    friction_n: Annotated[float, Meta(ge=0.0, le=10.0, description="Coulomb friction of the mechanism")] = 0.0
    resolution_m: Annotated[
        float, Meta(ge=0.0, le=limits.RESOLUTION_M.high, description="resolution of the encoders, 0 for none")
    ] = 0.0
    velocity_time_constant_s: Annotated[
        float,
        Meta(ge=0.0, le=limits.TIME_CONSTANT_S.high, description="time constant of the velocity filter, 0 for none"),
    ] = 0.0
    passivity_damping_ns_per_m: Annotated[
        float,
        Meta(
            ge=0.0,
            le=limits.DAMPING_NS_PER_M.high,
            description="largest damping of the passivity controller, 0 for none",
        ),
    ] = 0.0


def configure_stability(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("the device and its wall")
    hints = get_type_hints(CaseOptions, include_extras=True)
    for flag, key in FLAGS.items():
        kind, meta = get_args(hints[key])
        default = getattr(CaseOptions(), key)
        text = f"{meta.description} (default: {default:g})"
        group.add_argument(f"--{flag}", type=kind, default=default, metavar=find_unit(key).upper() or "N", help=text)
    group = parser.add_argument_group("measurement")
    kinds = group.add_mutually_exclusive_group()
    kinds.add_argument(
        "--map", choices=[*MAPS, "all"], help="stiffness limit as a function of wall damping, rate or delay"
    )
    add_flag(kinds, "--extremes", "run the tick at the extremes of all inputs and on random bytes")
    add_flag(kinds, "--bodies", "drag, balance and hold bodies of a [world], 1 g to 1 kg")
    cases = "run N random closed-loop cases and measure their speed"
    add_option(kinds, "--cases", cases, type=within(1), metavar="N")
    add_flag(group, "--compare", "with --map: also with hand, friction, encoder and filter")
    add_option(group, "--points", "points of a map", default=POINTS, type=within(2), metavar="N")
    add_option(group, "--ticks", "ticks of each random case", default=1000, type=within(1), metavar="M")
    add_option(group, "--seed", "seed of the random cases and bytes", default=0, type=within(0))
    add_option(group, "--garbage", "ticks of random bytes per scene", default=250_000, type=within(1), metavar="M")
    add_sweep_options(parser)
    add_output_options(parser)


SURFACES: Final = (
    "plane", "sphere", "sphere-inside", "cylinder", "cylinder-inside", "capped-cylinder", "capsule", "capsule-inside",
    "box", "ellipsoid", "ellipsoid-inside", "torus", "torus-inside",
)  # fmt: skip
METHODS: Final = ("euler_zxz", "euler_zyx", "rotation_vector", "midpoint", "montana_rk4", "montana_rk45")
Motion = Literal["constant", "changing"]
MOTIONS: Final[tuple[Motion, ...]] = ("constant", "changing")
TARGETS_M: Final = (1e-4, 1e-5, 1e-6, 1e-7, 1e-9, 1e-12)
DRIFT_STEPS: Final = 1_000_000
DRIFT_BLOCK: Final = 1000
"""Steps of the drift test between two measurements of the drift."""
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
    rates = "servo rates (default: 4 to 8000)"
    add_option(parser, "--rate", rates, nargs="+", type=within(4.0, 1e5), metavar="HZ")
    targets = "errors (m) to recommend methods for"
    add_option(parser, "--error-below", targets, default=TARGETS_M, nargs="+", type=within(1e-15, 1.0), metavar="M")
    steps = f"steps of the drift test (default: {DRIFT_STEPS})"
    add_option(parser, "--drift-steps", steps, type=within(DRIFT_BLOCK, 10**10), metavar="N")
    instead = parser.add_mutually_exclusive_group()
    add_flag(instead, "--meshes", "compare meshes of a ball, a cylinder and a torus with the exact shapes instead")
    add_flag(instead, "--heightmap", "compare a height map with a mesh of the same pixels instead")
    add_flag(parser, "--quick", "four servo rates, no other sweep, short drift test")
    add_sweep_options(parser)
    add_output_options(parser)
    parser.add_argument("--figures", type=Path, metavar="DIR", help=f"folder for accuracy-*.svg and {REPORT}")
