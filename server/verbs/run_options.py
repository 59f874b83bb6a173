"""Options of `softfinger run`; `server/verbs/run.py` imports the compiler, which takes longer than a help text."""

from __future__ import annotations

import argparse
from typing import Any, Final

from softfinger.server.arguments import duration

RIG: Final = "replay"
VIEW_RIG: Final = "simulated-hand"
"""Rig for --view, in which the mouse moves the hand."""

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


def configure(parser: argparse.ArgumentParser) -> None:
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
