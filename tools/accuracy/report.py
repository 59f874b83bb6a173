"""Terminal output of `softfinger accuracy`."""

from __future__ import annotations

import io
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any, Final, TextIO

from softfinger.config.files import write_new_file
from softfinger.tools.accuracy.front import group_by, select_standard

RATE_HZ: Final = 1000.0
"""Servo rate of the printed recommendations if it was measured; else the highest."""
WIDTH: Final = 120
"""Width of output that is not a terminal, characters."""


def print_report(result: dict[str, Any], file: TextIO | None = None) -> None:
    from rich.console import Console

    console = Console(highlight=False, file=file)
    if not console.is_terminal:
        console.width = WIDTH
    on = result["machine"]
    words = f"{on['processor']}, {on['processors']} processors, {on['system']}, Python {on['python']}"
    console.print(f"softfinger accuracy: fingertip {1e3 * result['radius_m']:g} mm; measured on {words}\n")
    for part in (
        format_paper_table,
        format_speed_table,
        format_orders_table,
        format_front_table,
        format_sweep_table,
        format_drift_table,
    ):
        text = part(result)
        if text.rows:
            console.print(text)
    for line in format_advice(result):
        console.print(line, soft_wrap=True)


def write_report(result: dict[str, Any], path: Path) -> None:
    text = io.StringIO()
    print_report(result, text)
    with write_new_file(path) as file:
        file.write("".join(f"{line.rstrip()}\n" for line in text.getvalue().splitlines()).encode())


def format_table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], text_columns: int) -> Any:
    """Return a table with text in the first `text_columns` columns, then numbers; long names break at `_`."""
    from rich import box
    from rich.table import Table

    grid = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    for number, name in enumerate(columns):
        grid.add_column(name.replace("_", "\n"), justify="left" if number < text_columns else "right", no_wrap=True)
    for row in rows:
        grid.add_row(*row)
    return grid


def format_paper_table(result: dict[str, Any]) -> Any:
    rows = [
        (row["motion"], row["method"], row["heading"], *(f"{error:.5f}" for error in row["max_error_mm"]))
        for row in result["paper"]
    ]
    return format_table(
        "the paper's experiment: largest difference, mm", ("axes", "method", "heading", *"xyz"), rows, 3
    )


def format_speed_table(result: dict[str, Any]) -> Any:
    times, classical = result["speed"], result["speed"]["classical"]
    columns = [(name.removesuffix("_ns_per_step"), times[name]) for name in times if name.endswith("_ns_per_step")]
    columns += [
        ("classical, steps of any length", classical["without_step_bound"]["ns_per_step"]),
        ("classical, with the complete path known in advance", classical["known_ahead"]["ns_per_step"]),
    ]
    zxz, unit = times["euler_zxz_ns_per_step"], times["reference_ns"]
    rows = [(name, f"{ns:.1f}", f"{ns / zxz:.2f}", f"{ns / unit:.3f}") for name, ns in columns]
    head = ("method", "ns a step", "over euler_zxz", f"over 100 operations, {unit:.0f} ns")
    return format_table("its time, world axes", head, rows, 1)


def format_orders_table(result: dict[str, Any]) -> Any:
    methods = list(dict.fromkeys(row["method"] for row in result["orders"]))
    rows = []
    for (surface, motion), group in group_by(result["orders"], "surface", "motion"):
        cells = {row["method"]: "-" if row["order"] is None else f"{row['order']:.2f}" for row in group}
        rows.append((surface, motion, *(cells.get(method, "") for method in methods)))
    return format_table("measured order (-: rounding)", ("surface", "rate", *methods), rows, 2)


def format_front_table(result: dict[str, Any]) -> Any:
    """Return a table with a row for each part of a front with one method, over a range of servo rates."""
    rows = []
    for (surface, motion), group in group_by(result["pareto"], "surface", "motion"):
        for method, run in groupby(group, key=lambda row: row["method"]):
            stretch = list(run)
            rates, ns, error = ([row[key] for row in stretch] for key in ("rate_hz", "ns_per_step", "max_error_m"))
            load = [row["ns_per_step"] / row["step_s"] * 1e-9 for row in stretch]
            rows.append(
                (surface, motion, method, span(rates, "g"), span(ns, ".0f"), span(load, ".0e"), span(error, ".0e"))
            )
    head = ("surface", "rate", "method", "Hz", "ns a step", "s per s", "error, m")
    return format_table("Pareto front: computing time per second of motion against error", head, rows, 3)


def span(values: Sequence[float], form: str) -> str:
    """Format the first and the last value, or one if they look alike."""
    first, last = format(values[0], form), format(values[-1], form)
    return first if first == last else f"{first} .. {last}"


def format_sweep_table(result: dict[str, Any]) -> Any:
    """Return the table of values varied at one servo rate, without the sweep over rates: the worst of all surfaces."""
    ladder = {id(row) for row in select_standard(result["trade"])}
    keys = ("motion", "turn_rate_rad_per_s", "given_ratio", "spin_ratio", "rate_hz")
    methods = list(dict.fromkeys(row["method"] for row in result["trade"]))
    rows = []
    for key, group in group_by((row for row in result["trade"] if id(row) not in ladder), *keys):
        worst: dict[str, float] = {}
        for row in group:
            worst[row["method"]] = max(worst.get(row["method"], 0.0), row["max_error_m"])
        values = ("own" if value is None else f"{value:g}" for value in key[1:])
        rows.append((key[0], *values, *(f"{worst[m]:.0e}" if m in worst else "" for m in methods)))
    head = ("rate", "rad/s", "r/R", "spin/roll", "Hz", *methods)
    return format_table("largest error on any surface, m", head, rows, 1)


def format_drift_table(result: dict[str, Any]) -> Any:
    methods = list(dict.fromkeys(row["method"] for row in result["drift"]))
    rows = []
    for (surface, steps), group in group_by(result["drift"], "surface", "steps"):
        cells = {row["method"]: f"{row['drift_m']:.0e}" for row in group}
        rows.append((surface, f"{steps:g}", *(cells.get(method, "") for method in methods)))
    return format_table("drift off the surface, m", ("surface", "steps", *methods), rows, 1)


def format_advice(result: dict[str, Any]) -> list[str]:
    """Return the recommendations for RATE_HZ; of errors with the same method only the smallest."""
    rates = {row["rate_hz"] for row in result["recommendations"]}
    rate = RATE_HZ if RATE_HZ in rates else max(rates)
    rows, cells = [row for row in result["recommendations"] if row["rate_hz"] == rate], []
    for _, group in group_by(rows, "surface", "motion", "method"):
        pick = min if group[0]["method"] else max
        cells.append(pick(group, key=lambda row: row["error_below_m"])["sentence"])
    return [str(sentence) for sentence in cells]
