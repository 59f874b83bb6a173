"""`run`: the daemon in the foreground, until its duration, the end of a recording, SIGINT or SIGTERM."""

from __future__ import annotations

import argparse
import logging
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

from softfinger.config.load import load_rig, load_scene
from softfinger.proxy.scene import explain
from softfinger.server.app import Daemon
from softfinger.server.progress import progress
from softfinger.server.realtime import Setting

log: Final = logging.getLogger(__name__)

TERMINAL_PERIOD_S: Final = 0.25
PLAIN_PERIOD_S: Final = 10.0

# Options that stand for a key of the rig: flag, key, type, metavar, help.
OVERRIDES: Final[tuple[tuple[str, str, Any, str, str], ...]] = (
    ("--device", "device.driver", str, "D", "driver, in place of the rig's"),
    ("--recording", "device.recording", str, "P", "poses to replay: file or name of a shipped recording"),
    ("--forces", "device.forces", str, "FILE", "where a replay keeps the force written: .csv or .npz"),
    ("--rate", "servo.rate_hz", float, "HZ", "ticks per second, 100 to 8000"),
    ("--realtime", "servo.realtime", str, "MODE", "auto, require or off"),
    ("--endpoint", "telemetry.endpoint", str, "URL", "where telemetry is published"),
)


def configure(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--rig", default="replay", help="rig file or the name of a shipped one (default: %(default)s)")
    parser.add_argument("--scene", default="paper-plane", help="scene file or name (default: %(default)s)")
    for flag, _, kind, metavar, text in OVERRIDES:
        parser.add_argument(flag, type=kind, metavar=metavar, help=text)
    parser.add_argument("--once", action="store_true", help="play a recording once instead of looping it")
    parser.add_argument("--duration", type=duration, metavar="S", help="stop after so many seconds of ticks")


def duration(text: str) -> float:
    """A time of the command line, s."""
    seconds = float(text)
    if not 0.0 < seconds < 1e9:
        raise argparse.ArgumentTypeError(f"{text}: a duration is more than 0 s")
    return seconds


def run(args: argparse.Namespace) -> int:
    changes, sources = {}, {}
    for flag, key, *_ in OVERRIDES:
        value = getattr(args, flag.removeprefix("--"))
        if value is not None:
            changes[key], sources[key] = value, f"command line {flag}"
    if args.once:
        changes["device.loop"], sources["device.loop"] = False, "command line --once"
    rig = load_rig(args.rig, changes, sources)
    scene = load_scene(args.scene)
    rate = rig.servo.rate_hz
    ticks = None if args.duration is None else max(1, round(args.duration * rate))

    with Daemon(rig, scene, ticks, report_settings) as daemon, stopped_by_signals(daemon):
        log.info("scene %s: %s", args.scene, explain(scene))
        log.info("device %s at %g Hz; telemetry on %s", daemon.device.info.name, rate, daemon.publisher.endpoint)
        with progress("compiling the kernels (once for each version and scene)"):
            daemon.start()
        watch(daemon, rate)
        log.info("stopped after %d ticks; force is zero", daemon.servo.ticks)
    return 0


def report_settings(settings: list[Setting]) -> None:
    """Log what the machine granted of the real-time settings, and what to do about the rest."""
    for setting in settings:
        if setting.ok:
            log.info("real time: %s %s", setting.name, setting.detail)
        else:
            log.warning("real time: %s refused: %s; %s", setting.name, setting.detail, setting.advice)


@contextmanager
def stopped_by_signals(daemon: Daemon) -> Iterator[None]:
    """SIGINT and SIGTERM end the servo in order; the handlers are put back afterwards."""
    numbers = (signal.SIGINT, signal.SIGTERM)
    before = {number: signal.signal(number, lambda *_: daemon.stop()) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def watch(daemon: Daemon, rate_hz: float) -> None:
    """Show that the servo runs, until it ends: one line kept up to date on a terminal, else a log line at times."""
    terminal = sys.stderr.isatty()
    period = TERMINAL_PERIOD_S if terminal else PLAIN_PERIOD_S
    begun = time.monotonic()
    try:
        while not daemon.wait(period):
            line = f"{daemon.servo.ticks} ticks, {daemon.servo.missed} missed, {daemon.servo.drops} records dropped"
            if terminal:
                elapsed = time.monotonic() - begun
                print(f"\r\x1b[K{elapsed:.0f} s: {line}; Ctrl-C stops", end="", file=sys.stderr, flush=True)
            else:
                log.info("%s", line)
    finally:
        if terminal:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
