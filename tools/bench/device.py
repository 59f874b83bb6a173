"""`bench device`: duration of the exchange with a rig's device, compared with an exchange of empty functions."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from softfinger.config.errors import ConfigError
from softfinger.config.load import load_rig
from softfinger.config.schema.pairing import find_single_device
from softfinger.drivers.registry import open_device
from softfinger.tools.exchange import EMPTY_READ, EMPTY_WRITE, READ, WRITE, Exchange, make_disarmed_guard
from softfinger.tools.exchange_figures import format_burst, format_table, summarize_burst, summarize_part
from softfinger.tools.measure import Array, draw_exceedance, format_realtime, show_and_draw


def run(args: argparse.Namespace) -> int:
    """Measure and print; returns the exit code. The device receives zero force only."""
    rig = load_rig(args.rig)
    rate = rig.servo.rate_hz
    with (
        open_device(find_single_device(rig), rate) as device,
        Exchange(device, rig, make_disarmed_guard(rig)) as exchange,
    ):
        rows = exchange.record(args.seconds)
        burst = exchange.burst()
        failure = exchange.failure()
        if failure is not None:
            raise failure
        name, settings = device.info.name, exchange.settings
    if len(rows) == 0:
        raise ConfigError(f"--rig {args.rig}: the recording ended before the first exchange: use a looping one")
    result: dict[str, Any] = {"rig": args.rig, "device": name, "rate_hz": rate} | summarize_part(rows, rate)
    result["without_pauses"] = summarize_burst(burst) if len(burst) else None
    result["realtime"] = {setting.name: setting.ok for setting in settings}
    lines = [f"exchange with {name} at {rate:g} Hz, {len(rows)} ticks", *format_table(result)]
    if len(burst):
        lines.append(format_burst(result["without_pauses"]))
    lines.append(format_realtime(result["realtime"]))
    return show_and_draw(args, result, lines, lambda path: draw(path, rows, f"{name} at {rate:g} Hz"))


def draw(path: Path, rows: Array, title: str) -> None:
    """Draw the fraction of ticks in which read, write, and the empty pair took longer than a time."""
    parts = {"read": rows[:, READ], "write": rows[:, WRITE], "empty pair": rows[:, EMPTY_READ] + rows[:, EMPTY_WRITE]}
    draw_exceedance(path, parts, 1e-3, "time", "ticks that took longer", title)
