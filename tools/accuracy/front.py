"""Evaluation of the rows of `softfinger accuracy`: measured orders, Pareto fronts, recommendations."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from math import log
from typing import Any, Final

ROUNDING_M: Final = 1e-14
"""Path errors below this are rounding, also of the reference: they count as equal and show no order."""
GAIN_SHARE: Final = 0.5
"""Fraction of the best error so far below which a more expensive point is worth its cost."""
CLEAR_FACTOR: Final = 10.0
"""Errors above this many ROUNDING_M show an order."""

Row = dict[str, Any]


def select_standard(rows: Iterable[Row]) -> list[Row]:
    """Return the rows of the sweep over servo rates: original surface, first rotation rate and first spin ratio."""
    surface_rows = [row for row in rows if row["given_ratio"] is None]
    if not surface_rows:
        return []
    first = surface_rows[0]
    keys = ("turn_rate_rad_per_s", "spin_ratio")
    return [row for row in surface_rows if all(row[key] == first[key] for key in keys)]


def group_by(rows: Iterable[Row], *keys: str) -> Iterable[tuple[tuple[Any, ...], list[Row]]]:
    """Group rows that agree in `keys`, in the order of their first appearance."""
    groups: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        groups.setdefault(tuple(row[key] for key in keys), []).append(row)
    return groups.items()


def find_front(rows: Sequence[Row]) -> list[Row]:
    """Return the rows worth choosing, cheapest first; each one at least halves the error of all cheaper ones.

    Cost is the computing time per second of motion, `ns_per_step / step_s`. The error is `max_error_m`; errors within
    rounding count as equal.
    """
    best, chosen = float("inf"), []
    for row in sorted(rows, key=lambda row: (row["ns_per_step"] / row["step_s"], row["max_error_m"])):
        error = max(row["max_error_m"], ROUNDING_M)
        if error < GAIN_SHARE * best:
            best = error
            chosen.append(row)
    return chosen


def find_fronts(rows: Iterable[Row]) -> list[Row]:
    return [row for _, group in group_by(select_standard(rows), "surface", "motion") for row in find_front(group)]


def fit_orders(rows: Iterable[Row]) -> list[Row]:
    """Fit the slope of error against step of each method, surface and motion to the three smallest clear errors.

    The order is None if fewer errors are clear of rounding, and for `montana_rk45` at a constant rate, where the error
    follows the tolerance.
    """
    fitted = []
    for (surface, motion, method), group in group_by(select_standard(rows), "surface", "motion", "method"):
        clear = sorted((row["step_s"], row["max_error_m"]) for row in group)
        clear = [point for point in clear if point[1] > CLEAR_FACTOR * ROUNDING_M][:3]
        slope = None
        if len(clear) == 3 and (method, motion) != ("montana_rk45", "constant"):
            (short, small), _, (long, large) = clear
            slope = log(large / small) / log(long / short)
        fitted.append({"surface": surface, "motion": motion, "method": method, "order": slope})
    return fitted


def list_recommendations(rows: Iterable[Row], targets_m: Sequence[float]) -> list[Row]:
    """Return the cheapest sufficient method for each surface, motion, servo rate and largest error allowed.

    `method` is None if no method is accurate enough.
    """
    recommended = []
    for (surface, motion, rate), group in group_by(select_standard(rows), "surface", "motion", "rate_hz"):
        for target in targets_m:
            fit = [row for row in group if row["max_error_m"] <= target]
            best = min(fit, key=lambda row: row["ns_per_step"], default=None)
            recommended.append(
                {
                    "surface": surface,
                    "motion": motion,
                    "rate_hz": rate,
                    "error_below_m": target,
                    "method": best and best["method"],
                    "ns_per_step": best and best["ns_per_step"],
                    "max_error_m": best and best["max_error_m"],
                    "sentence": format_sentence(surface, motion, rate, target, best, group),
                }
            )
    return recommended


def format_sentence(
    surface: str, motion: str, rate: float, target: float, best: Row | None, group: Sequence[Row]
) -> str:
    question = f"{surface}, {motion} rate: for an error below {format_length(target)} at {rate:g} Hz"
    if best is None:
        least = min(group, key=lambda row: row["max_error_m"])
        return f"{question} no method does: {least['method']} reaches {format_length(least['max_error_m'])}"
    return f"{question} use {best['method']}: {best['ns_per_step']:.0f} ns"


def format_length(meters: float) -> str:
    """Format a length in the most readable unit."""
    for unit, name in ((1e-3, "mm"), (1e-6, "um"), (1e-9, "nm")):
        if meters >= unit:
            return f"{meters / unit:.3g} {name}"
    return f"{meters / 1e-12:.2g} pm"
