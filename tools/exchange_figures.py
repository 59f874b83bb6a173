"""Figures of the rows of an exchange: duration relative to an empty exchange, and age of the samples."""

from __future__ import annotations

from typing import Any, Final

import numpy as np

from softfinger.drivers.base import SAMPLE_TIME, STALE
from softfinger.tools import exchange
from softfinger.tools.measure import QUANTILES_HEAD, Array, compute_quantiles, format_quantiles

HISTOGRAM_S: Final = tuple(float(f"{base}e{power}") for power in range(-8, 0) for base in (1, 2, 5))
"""Edges of the histogram's bins: 10 ns to half a second, three per decade."""

TIMES: Final = ("read", "write", "cycle")


def summarize_part(rows: Array, rate_hz: float) -> dict[str, Any]:
    """Return the times of a part, s, overall and as medians over blocks of a second, and ratios to the empty exchange.

    rows  (n, ROW_SIZE), n at least 1
    """
    block = max(1, min(round(rate_hz), len(rows)))
    read, write = rows[:, exchange.READ], rows[:, exchange.WRITE]
    empty_read, empty_write = rows[:, exchange.EMPTY_READ], rows[:, exchange.EMPTY_WRITE]
    result: dict[str, Any] = {"ticks": len(rows), "seconds": measure_elapsed(rows)}
    pairs = ((read, empty_read), (write, empty_write), (read + write, empty_read + empty_write))
    for name, (values, reference) in zip(TIMES, pairs, strict=True):
        measured, empty = compute_quantiles(values, block), compute_quantiles(reference, block)
        ratios = {at: measured["blocks"][at] / max(empty["blocks"][at], 1e-9) for at in ("p50", "p99")}
        result[name] = measured | {"empty": empty, "over_empty": ratios, "histogram": make_histogram(values)}
    result["late"] = compute_quantiles(rows[:, exchange.LATE], block)
    return result | count_freshness(rows)


def count_freshness(rows: Array) -> dict[str, Any]:
    """Return the shares of reads and writes with status STALE, new samples a second, and steps of the device's time."""
    stale = rows[:, exchange.READ_STATUS] == STALE
    steps = np.diff(rows[~stale, exchange.SAMPLE + SAMPLE_TIME])
    fresh = int(np.sum(~stale))
    return {
        "stale_share": float(np.mean(stale)),
        "limited_share": float(np.mean(rows[:, exchange.WRITE_STATUS] == STALE)),
        "new_samples_hz": fresh / max(measure_elapsed(rows), 1e-9),
        "sample_step_s": {"min": float(steps.min()), "p50": float(np.median(steps)), "max": float(steps.max())}
        if len(steps) and np.isfinite(steps).all()
        else None,
    }


def measure_elapsed(rows: Array) -> float:
    """Return the time from the first tick to the end of the last one, s; the last one counts as long as the median."""
    if len(rows) < 2:
        return float(rows[0, exchange.READ] + rows[0, exchange.WRITE])
    return float(rows[-1, exchange.START] - rows[0, exchange.START] + np.median(np.diff(rows[:, exchange.START])))


def summarize_burst(rows: Array) -> dict[str, Any]:
    """Return exchanges and new samples per second of a part without pauses, including the time of the loop itself."""
    return {"exchanges": len(rows), "exchanges_hz": len(rows) / max(measure_elapsed(rows), 1e-9)} | count_freshness(
        rows
    )


def make_histogram(values: Array) -> list[list[float]]:
    """Return pairs of upper edge (s) and count of the non-empty bins; the last bin has no end."""
    counts = np.bincount(np.searchsorted(HISTOGRAM_S, values), minlength=len(HISTOGRAM_S) + 1)
    edges = (*HISTOGRAM_S, float(values.max()))
    return [[edge, int(count)] for edge, count in zip(edges, counts, strict=True) if count]


def format_table(result: dict[str, Any]) -> list[str]:
    lines = [
        "  us; in brackets the median over blocks of 1 s; empty: functions that do nothing, in the same ticks",
        f"  {'':<14}{QUANTILES_HEAD}",
    ]
    for name in TIMES:
        for label, figures in ((name, result[name]), ("  empty", result[name]["empty"])):
            lines.append(f"  {label:<14}{format_quantiles(figures)}")
    ratios = (f"{name} {result[name]['over_empty']['p50']:.1f}" for name in TIMES)
    lines.append(f"  times the empty exchange, p50: {', '.join(ratios)}")
    step = result["sample_step_s"]
    steps = "" if step is None else f"; device time steps by {step['p50'] * 1e3:.3f} ms (p50)"
    lines.append(
        f"  {result['new_samples_hz']:.1f} new samples a second, "
        f"{result['stale_share']:.2%} of the reads repeat one{steps}"
    )
    return lines


def format_burst(result: dict[str, Any]) -> str:
    """Format the figures of a part without pauses."""
    return (
        f"  without pauses: {result['exchanges_hz']:.0f} exchanges a second, "
        f"{result['new_samples_hz']:.0f} with a new sample"
    )
