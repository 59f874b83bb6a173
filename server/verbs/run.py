"""`softfinger run`: the daemon in the foreground, until its duration, the end of a recording, or a signal."""

from __future__ import annotations

import argparse
import logging
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from softfinger.config.errors import ConfigError
from softfinger.config.load import load_faults, load_rig, load_scene
from softfinger.config.schema import Faults, Rig
from softfinger.drivers import base, registry
from softfinger.proxy.kernels.jit.decorators import CACHE_DIR, KERNEL_FOLDER
from softfinger.proxy.scene import explain
from softfinger.server import signals
from softfinger.server.app import Daemon
from softfinger.server.arguments import find_default_rig
from softfinger.server.loop import shutdown
from softfinger.server.loop.realtime import Setting
from softfinger.server.progress import name_warmup, report_compilation, show_counter
from softfinger.server.verbs.options import OVERRIDES, RIG, VIEW_RIG
from softfinger.server.viewer.door.process import PageProcess, check_viewer, find_program_name, monitor_command
from softfinger.server.watcher import Watcher

log: Final = logging.getLogger(__name__)

TERMINAL_PERIOD_S: Final = 0.25
PLAIN_PERIOD_S: Final = 10.0


def run(args: argparse.Namespace) -> int:
    changes, sources = {}, {}
    for flag, key, *_ in OVERRIDES:
        value = getattr(args, flag.removeprefix("--"))
        if value is not None:
            changes[key], sources[key] = value, f"command line {flag}"
    if args.once:
        changes["device.loop"], sources["device.loop"] = False, "command line --once"
    if args.record is not None and not (folder := Path(args.record).absolute().parent).is_dir():
        raise ConfigError(
            f"--record {args.record}: the folder {folder} does not exist: create it, or choose another file"
        )
    if args.view:
        check_viewer()
    with report_compilation("kernels that call the device"):  # compiled when the driver is imported
        rig = load_rig(args.rig or find_default_rig(args.scene, VIEW_RIG if args.view else RIG), changes, sources)
    scene = load_scene(args.scene)
    check_device_options(rig, sources)
    rate = rig.servo.rate_hz
    ticks = None if args.duration is None else max(1, round(args.duration * rate))

    if args.forces is not None and len(rig.tables) > 1:
        raise ConfigError("--forces: one file cannot hold the forces of several fingers: set one for each in the rig")

    faults = None if args.inject is None else load_faults(args.inject)
    daemon = Daemon(rig, scene, ticks, report_settings, scene_name=args.scene, faults=faults)
    watchers = list[Watcher]()
    page = None
    try:
        if args.view:
            log_options = ["-q"] if args.quiet else ["-v"] if args.verbose else []
            page = PageProcess(
                daemon.publisher.endpoint, daemon.commands_endpoint, log_options, daemon.publish_page_exit
            )
        if args.record is not None:
            daemon.recordings.record(args.record, args.scene)
        start_watchers(daemon, watchers, required=args.watcher)
        if faults is not None:
            log.warning("faults are injected, from %s: %s", args.inject, format_faults(faults, rate))
        announce(daemon, args.scene, suggest_view=page is None and args.rig is None)
        start_s = time.monotonic()
        with name_warmup(args.scene), report_compilation("kernels of the scene"):
            is_cached = daemon.servo.compile()
        if not is_cached:
            cache_text = f"stored in {CACHE_DIR}" if KERNEL_FOLDER.problem() is None else "not stored"
            log.info("compiled in %.0f s; %s", time.monotonic() - start_s, cache_text)
        with signals.stop_on_signal(daemon.stop, daemon.pause, daemon.switch_file):
            daemon.start()
            show_progress(daemon, page, watchers)
            log.info("stopped after %d ticks; force is zero", daemon.servo.ticks)
    finally:
        with signals.defer_signals():
            first = sys.exception()
            pages = [] if page is None else [page.close]
            other_steps = [*(watcher.dismiss for watcher in watchers), *pages]
            failed = shutdown.run_all_steps(lambda: daemon.close(first), *other_steps, first=first)
        if failed is not None and failed is not first:
            raise failed
    return signals.stop_exit_code()


def check_device_options(rig: Rig, sources: Mapping[str, str]) -> None:
    """Raise ConfigError for an option that the driver of a device lacks; `sources` has the option by dotted key."""
    for config in rig.tables.values():
        known = {"driver", *registry.load(config.driver).Options.__struct_fields__}
        for dotted, source in sources.items():
            table, key = dotted.split(".")
            if table == "device" and key not in known:
                raise ConfigError(
                    f"{source}: driver '{config.driver}' has no option {key}: remove it, or add --device replay"
                )


def announce(daemon: Daemon, scene_name: str, suggest_view: bool) -> None:
    rendering, telemetry = daemon.rendering, daemon.publisher.endpoint
    if suggest_view:
        log.info("`%s run --view` opens a browser page on which the mouse moves the hand", find_program_name())
    log.info("scene %s: %s", scene_name, explain(rendering.scene))
    log.info(
        "device %s at %g Hz; telemetry on %s", base.join_names(daemon.devices), rendering.rig.servo.rate_hz, telemetry
    )
    log.info("commands on %s", daemon.commands_endpoint or "no endpoint: off")
    if (daemon.commands_endpoint or "").startswith("tcp:"):
        log.warning("commands by tcp are open to every user of this machine; ipc:///PATH excludes other users")
    for name, endpoint in daemon.public.items():
        log.info("%s for other machines on %s, with keys", name, endpoint)
    if daemon.metrics_endpoint is not None:
        log.info("metrics on %s/metrics", daemon.metrics_endpoint)
    log.info("to see it, in another terminal: %s; to stop it: Ctrl-C", monitor_command(telemetry))


def format_faults(faults: Faults, rate_hz: float) -> str:
    return ", ".join(f"{fault.kind} from tick {fault.window(rate_hz)[0]} on" for fault in faults.fault)


def report_settings(settings: list[Setting]) -> None:
    """Log granted settings, and one warning for all refused settings with the same advice."""
    refused: dict[str, list[Setting]] = {}
    for setting in settings:
        if setting.ok:
            log.info("real time: %s %s", setting.name, setting.detail)
        else:
            refused.setdefault(setting.advice, []).append(setting)
    for advice, same in refused.items():
        names = ", ".join(setting.name for setting in same)
        log.warning("real time: %s refused: %s; %s", names, same[0].detail, advice)


def start_watchers(daemon: Daemon, watchers: list[Watcher], required: bool) -> None:
    """Start a watcher for each device whose force another process can remove, and append it to `watchers`.

    Raises ConfigError if `required` and there is another device.
    """
    for device in daemon.devices:
        zero_command = device.zero_command()
        if zero_command is not None:
            watchers.append(Watcher(*zero_command))
            log.info("watcher: another process removes the force of %s if this one is killed", device.info.name)
        elif required:
            raise ConfigError(
                f"--watcher: no other process can remove the force of {device.info.name} "
                "(see docs/devices/overview.md): remove --watcher"
            )


def show_progress(daemon: Daemon, page: PageProcess | None, watchers: Sequence[Watcher]) -> None:
    """Show progress and supervise the other processes until the servo ends.

    The progress is a line updated in place on a terminal, otherwise a log line at intervals.
    """
    with show_counter() as show:
        shown_s = time.monotonic()
        while not daemon.wait(TERMINAL_PERIOD_S):
            for text in filter(None, (watcher.supervise() for watcher in watchers)):
                log.error("%s", text)
            if page is not None:
                page.supervise()
            if show is None and time.monotonic() - shown_s < PLAIN_PERIOD_S:
                continue
            shown_s, servo = time.monotonic(), daemon.servo
            line = f"{servo.ticks} ticks, {servo.missed} missed, {servo.records.drops} records dropped"
            if show is None:
                log.info("%s", line)
            else:
                show(f"{line}; Ctrl-C stops")
