"""`softfinger devices`: list of devices from `server.verbs.devices`, or a probe of a device."""

from __future__ import annotations

import argparse
from typing import Final

from softfinger.config.errors import ConfigError
from softfinger.server.verbs import devices

PUSH_N: Final = 0.2
"""A tenth of the force of most devices, and more than the friction of a good one."""


def configure(parser: argparse.ArgumentParser) -> None:
    devices.configure(parser)
    parser.add_argument(
        "--probe",
        nargs="?",
        const="",
        metavar="FILE",
        help="open the rig's device (default: the first that is attached) for ten seconds with zero force; show rate, "
        "range, noise, buttons and axes, and write a device report (softfinger-DRIVER-report.json)",
    )
    parser.add_argument(
        "--push",
        action="store_true",
        help=f"with --probe: then push with {PUSH_N:g} N along each axis and back, and ask what was felt. THE HANDLE "
        "MOVES: hold it lightly",
    )


def run(args: argparse.Namespace) -> int:
    """List the devices or probe one; returns the exit code."""
    if args.probe is not None:
        from softfinger.tools.doctor import probe  # compiles the exchange's loop, which a list does without

        return probe.run(args)
    if args.push:
        raise ConfigError("--push belongs to a probe: add --probe")
    return devices.run(args)
