"""`softfinger run`: the daemon in the foreground, until its duration, the end of a recording, or a signal."""

from __future__ import annotations

import argparse
import logging
import sys
import time
from typing import Any, Final

from softfinger.config.errors import ConfigError
from softfinger.config.load import load_faults, load_rig, load_scene
from softfinger.config.schema import Faults
from softfinger.drivers import base
from softfinger.proxy.kernels.jit.decorators import CACHE_DIR, KEPT
from softfinger.proxy.scene import explain
from softfinger.server import signals
from softfinger.server.app import Daemon
from softfinger.server.arguments import default_rig, duration
from softfinger.server.loop import shutdown
from softfinger.server.loop.realtime import Setting
from softfinger.server.progress import counter, making
from softfinger.server.viewer.door.process import Shown, check_viewer, program, shown_by
from softfinger.server.watcher import Watcher

log: Final = logging.getLogger(__name__)

RIG: Final = "replay"
LED_RIG: Final = "simulated-hand"
"""Rig for --view, in which the mouse moves the hand."""

TERMINAL_PERIOD_S: Final = 0.25
PLAIN_PERIOD_S: Final = 10.0

# Options that override a key of the rig: flag, key, type, metavar, help.
OVERRIDES: Final[tuple[tuple[str, str, Any, str, str], ...]] = (
    ("--device", "device.driver", str, "D", "driver, in place of the rig's"),
    ("--recording", "device.recording", str, "P", "poses to replay: file or name of a shipped recording"),
    ("--forces", "device.forces", str, "FILE", "where a replay keeps the force written: .csv or .npz"),
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
        f"--view {LED_RIG})",
    )
    parser.add_argument("--scene", default="paper-plane", help="scene file or name (default: %(default)s)")
    for flag, _, kind, metavar, text in OVERRIDES:
        parser.add_argument(flag, type=kind, metavar=metavar, help=text)
    parser.add_argument("--once", action="store_true", help="play a recording once instead of looping it")
    parser.add_argument(
        "--watcher", action="store_true", help="a small process that takes the force off if this one is killed"
    )
    parser.add_argument("--record", metavar="FILE", help="record every tick and event into a new .mcap file")
    parser.add_argument(
        "--inject", metavar="FILE", help="faults between device and loop, to try what becomes of them: file or name"
    )
    parser.add_argument("--view", action="store_true", help="open a page in the browser, with a mouse for a hand")
    parser.add_argument("--duration", type=duration, metavar="S", help="stop after so many seconds of ticks")


def run(args: argparse.Namespace) -> int:
    changes, sources = {}, {}
    for flag, key, *_ in OVERRIDES:
        value = getattr(args, flag.removeprefix("--"))
        if value is not None:
            changes[key], sources[key] = value, f"command line {flag}"
    if args.once:
        changes["device.loop"], sources["device.loop"] = False, "command line --once"
    if args.view:
        check_viewer()
    with making("kernels that call the device"):  # compiled when the driver is imported
        rig = load_rig(args.rig or default_rig(args.scene, LED_RIG if args.view else RIG), changes, sources)
    scene = load_scene(args.scene)
    rate = rig.servo.rate_hz
    ticks = None if args.duration is None else max(1, round(args.duration * rate))

    if args.forces is not None and len(rig.tables) > 1:
        raise ConfigError("--forces: one file cannot keep the force of several fingers: give each its own in the rig")

    faults = None if args.inject is None else load_faults(args.inject)
    daemon = Daemon(rig, scene, ticks, report_settings, scene_name=args.scene, faults=faults)
    watchers = list[Watcher]()
    page = None
    try:
        if args.view:
            loudness = ["-q"] if args.quiet else ["-v"] if args.verbose else []
            page = Shown(daemon.publisher.endpoint, daemon.commands_endpoint, loudness, daemon.page_ended)
        if args.record is not None:
            daemon.recordings.record(args.record, args.scene)
        if args.watcher:
            watchers = watch_over(daemon)
        if faults is not None:
            log.warning("faults are injected, from %s: %s", args.inject, told(faults, rate))
        announce(daemon, args.scene, page is not None)
        begun = time.monotonic()
        with making("kernels of the scene"):
            found = daemon.servo.compile()
        if not found:
            where = f"kept in {CACHE_DIR}" if KEPT.problem() is None else "not kept"
            log.info("compiled in %.0f s; %s", time.monotonic() - begun, where)
        with signals.asked(daemon.stop, daemon.pause):
            daemon.start()
            watch(daemon, page)
            log.info("stopped after %d ticks; force is zero", daemon.servo.ticks)
    finally:
        with signals.held():
            first = sys.exception()
            pages = [] if page is None else [page.close]
            others = [*(watcher.dismiss for watcher in watchers), *pages]
            failed = shutdown.run_all_steps(lambda: daemon.close(first), *others, first=first)
        if failed is not None and failed is not first:
            raise failed
    return signals.code_of_stop()


def announce(daemon: Daemon, scene_name: str, shown: bool) -> None:
    """Log scene, device and endpoints; `shown`: a page is open."""
    rendering, telemetry = daemon.rendering, daemon.publisher.endpoint
    if not shown:
        log.info(
            "--view shows it in the browser, with the mouse for a hand: `%s run --view`, `make run ARGS=--view`",
            program(),
        )
    log.info("scene %s: %s", scene_name, explain(rendering.scene))
    log.info("device %s at %g Hz; telemetry on %s", base.names(daemon.devices), rendering.rig.servo.rate_hz, telemetry)
    log.info("commands on %s", daemon.commands_endpoint or "no endpoint: off")
    if (daemon.commands_endpoint or "").startswith("tcp:"):
        log.warning("commands by tcp: every user of this machine may command; ipc:///PATH keeps others out")
    for name, endpoint in daemon.public.items():
        log.info("%s for other machines on %s, by key", name, endpoint)
    if daemon.metrics_endpoint is not None:
        log.info("metrics on %s/metrics", daemon.metrics_endpoint)
    log.info("to see it, in another terminal: %s; to stop it: Ctrl-C", shown_by(telemetry))


def told(faults: Faults, rate_hz: float) -> str:
    """Return the injected faults and their first ticks as text."""
    return ", ".join(f"{fault.kind} from tick {fault.window(rate_hz)[0]} on" for fault in faults.fault)


def report_settings(settings: list[Setting]) -> None:
    """Log the real-time settings that the system granted, and those refused with advice."""
    for setting in settings:
        if setting.ok:
            log.info("real time: %s %s", setting.name, setting.detail)
        else:
            log.warning("real time: %s refused: %s; %s", setting.name, setting.detail, setting.advice)


def watch_over(daemon: Daemon) -> list[Watcher]:
    """Start a watcher for each device of a daemon.

    Raises ConfigError if no other process can remove the force of a device.
    """
    words = []
    for device in daemon.devices:
        word = device.last_word()
        if word is None:
            raise ConfigError(
                f"--watcher: no other process can take a force off {device.info.name} "
                "(docs/devices/overview.md says what is left there): leave it out"
            )
        words.append(word)
    return [Watcher(*word) for word in words]


def watch(daemon: Daemon, page: Shown | None) -> None:
    """Show progress until the servo ends: a line updated in place on a terminal, otherwise a log line at intervals."""
    with counter() as show:
        told = time.monotonic()
        while not daemon.wait(TERMINAL_PERIOD_S):
            if page is not None:
                page.look()
            if show is None and time.monotonic() - told < PLAIN_PERIOD_S:
                continue
            told, servo = time.monotonic(), daemon.servo
            line = f"{servo.ticks} ticks, {servo.missed} missed, {servo.records.drops} records dropped"
            if show is None:
                log.info("%s", line)
            else:
                show(f"{line}; Ctrl-C stops")
