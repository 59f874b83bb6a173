"""Options of `softfinger stability`."""

from __future__ import annotations

import argparse
from typing import Annotated, Final, get_args, get_type_hints

import msgspec
from msgspec import Meta

from softfinger.config import limits
from softfinger.config.fields import find_unit
from softfinger.server.arguments import add_flag, add_option
from softfinger.tools.options import add_output_options, add_sweep_options

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
    kinds.add_argument("--cases", type=int, metavar="N", help="run N random closed-loop cases and measure their speed")
    add_flag(group, "--compare", "with --map: also with hand, friction, encoder and filter")
    add_option(group, "--points", "points of a map", default=POINTS, metavar="N")
    add_option(group, "--ticks", "ticks of each random case", default=1000, metavar="M")
    add_option(group, "--seed", "seed of the random cases and bytes", default=0)
    add_option(group, "--garbage", "ticks of random bytes per scene", default=250_000, metavar="M")
    add_sweep_options(parser)
    add_output_options(parser)
