"""The terminal output of `softfinger accuracy`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final

from softfinger.tools.accuracy_front import Row, grouped, standard

RATE_HZ: Final = 1000.0
"""Servo rate that the recommendations are printed for, where it was measured; else the highest."""


def print_report(result: dict[str, Any]) -> None:
    """All sections as tables."""
    from rich.console import Console

    console = Console(highlight=False)
    for part in (paper_table, speed_table, orders_table, front_table, sweep_table, drift_table):
        console.print(part(result))
    for line in advice(result):
        console.print(line, soft_wrap=True)


def table(title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], left: int) -> Any:
    """A table whose first `left` columns are words and whose others are numbers."""
    from rich import box
    from rich.table import Table

    made = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False)
    for number, name in enumerate(columns):
        made.add_column(name, justify="left" if number < left else "right", no_wrap=True)
    for row in rows:
        made.add_row(*row)
    return made


def paper_table(result: dict[str, Any]) -> Any:
    rows = [
        (row["motion"], row["method"], row["heading"], *(f"{error:.5f}" for error in row["max_error_mm"]))
        for row in result["paper"]
    ]
    return table("the paper's experiment: largest difference, mm", ("axes", "method", "heading", *"xyz"), rows, 3)


def speed_table(result: dict[str, Any]) -> Any:
    times, classical = result["speed"], result["speed"]["classical"]
    named = [(name.removesuffix("_ns_per_step"), times[name]) for name in times if name.endswith("_ns_per_step")]
    named += [
        ("classical, steps of any length", classical["without_step_bound"]["ns_per_step"]),
        ("classical, the whole path known ahead", classical["known_ahead"]["ns_per_step"]),
    ]
    zxz, unit = times["euler_zxz_ns_per_step"], times["reference_ns"]
    rows = [(name, f"{ns:.1f}", f"{ns / zxz:.2f}", f"{ns / unit:.3f}") for name, ns in named]
    head = ("method", "ns a step", "over euler_zxz", f"of {unit:.0f} ns, 100 operations")
    return table("its time, world axes", head, rows, 1)


def orders_table(result: dict[str, Any]) -> Any:
    methods = list(dict.fromkeys(row["method"] for row in result["orders"]))
    rows = []
    for (surface, motion), group in grouped(result["orders"], "surface", "motion"):
        found = {row["method"]: "-" if row["order"] is None else f"{row['order']:.2f}" for row in group}
        rows.append((surface, motion, *(found.get(method, "") for method in methods)))
    return table("measured order (-: rounding)", ("surface", "rate", *methods), rows, 2)


def front_table(result: dict[str, Any]) -> Any:
    rows = [
        (
            row["surface"], row["motion"], row["method"], f"{row['rate_hz']:g}", f"{row['ns_per_step']:.0f}",
            f"{row['ns_per_step'] / row['step_s'] * 1e-9:.1e}", f"{row['max_error_m']:.1e}",
            f"{row['spin_error_rad']:.1e}",
        )
        for row in result["pareto"]
    ]  # fmt: skip
    head = ("surface", "rate", "method", "Hz", "ns a step", "s per s", "error, m", "spin, rad")
    return table("Pareto front: computing time against error", head, rows, 3)


def sweep_table(result: dict[str, Any]) -> Any:
    """What was varied at one servo rate: the rows that are not part of the ladder."""
    ladder = {id(row) for row in standard(result["trade"])}
    keys = ("surface", "motion", "turn_rate_rad_per_s", "curvature_ratio", "spin_ratio", "rate_hz")
    methods = list(dict.fromkeys(row["method"] for row in result["trade"]))
    rows = []
    for key, group in grouped((row for row in result["trade"] if id(row) not in ladder), *keys):
        found = {row["method"]: f"{row['max_error_m']:.0e}" for row in group}
        rows.append((*key[:2], *(f"{value:.3g}" for value in key[2:]), *(found.get(method, "") for method in methods)))
    head = ("surface", "rate", "rad/s", "r/R", "spin/roll", "Hz", *methods)
    return table("largest error, m", head, rows, 2)


def drift_table(result: dict[str, Any]) -> Any:
    methods = list(dict.fromkeys(row["method"] for row in result["drift"]))
    rows = []
    for (surface, steps), group in grouped(result["drift"], "surface", "steps"):
        found = {row["method"]: f"{row['drift_m']:.0e}" for row in group}
        rows.append((surface, f"{steps:g}", *(found.get(method, "") for method in methods)))
    return table("drift off the surface, m", ("surface", "steps", *methods), rows, 1)


def advice(result: dict[str, Any]) -> list[str]:
    """The recommendations for RATE_HZ."""
    found: list[Row] = result["recommendations"]
    rates = {row["rate_hz"] for row in found}
    rate = RATE_HZ if RATE_HZ in rates else max(rates)
    return [row["sentence"] for row in found if row["rate_hz"] == rate]
