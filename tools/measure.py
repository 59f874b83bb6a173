"""Common parts of the measuring verbs: percentiles, tables, figures, JSON, and reference programs in C."""

from __future__ import annotations

import argparse
import json
import shutil
import subprocess
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.server.offline.figures import make_figure, save

Array = NDArray[np.float64]

QUANTILES: Final = {"p50": 50.0, "p99": 99.0, "p999": 99.9, "max": 100.0}


def compute_quantiles(values: Array, block: int) -> dict[str, Any]:
    """Return percentiles of `values` (n,) and, under `blocks`, the median of each over blocks of `block` values.

    Compare the median over blocks: a stall of the machine spoils only one block.
    """
    quantiles: dict[str, Any] = {name: float(np.percentile(values, at)) for name, at in QUANTILES.items()}
    used = len(values) // block * block
    blocks = values[:used].reshape(-1, block) if used else values.reshape(1, -1)
    quantiles["blocks"] = {name: float(np.median(np.percentile(blocks, at, axis=1))) for name, at in QUANTILES.items()}
    return quantiles


def show(result: Mapping[str, Any], as_json: bool, lines: Iterable[str]) -> None:
    print(json.dumps(result, indent=2) if as_json else "\n".join(lines))


def show_and_draw(
    args: argparse.Namespace, result: Mapping[str, Any], lines: Iterable[str], draw: Callable[[Path], None]
) -> int:
    """Print a result as the output options require, and draw it if a figure is requested; returns exit code 0."""
    show(result, args.json, lines)
    if args.plot is not None:
        draw(args.plot)
    return 0


def draw_lines(
    path: Path,
    lines: Mapping[str, tuple[Any, Any]],
    x: str,
    y: str,
    *,
    title: str = "",
    style: str = "-",
    log: bool = False,
) -> None:
    """Draw a line for each name, with logarithmic axes if `log`."""
    drawing = make_figure()
    axes = drawing.add_subplot()
    for name, (at, values) in lines.items():
        axes.plot(at, values, style, label=name)
    scale = "log" if log else "linear"
    axes.set(xscale=scale, yscale=scale, xlabel=x, ylabel=y, title=title)
    axes.legend(fontsize="small")
    axes.grid(True, alpha=0.3)
    save(drawing, path)


def draw_exceedance(path: Path, seconds: Mapping[str, Array], least_us: float, time: str, of: str, title: str) -> None:
    """Draw the share of values above each duration, us, a line per name; smaller values count as `least_us`."""
    lines = {
        name: (np.sort(values).clip(1e-6 * least_us) * 1e6, 1.0 - np.arange(len(values)) / len(values))
        for name, values in seconds.items()
    }
    draw_lines(path, lines, f"{time}, us", f"share of {of}", title=title, log=True)


def draw_bars(path: Path, costs: Mapping[str, float], unit: str) -> None:
    """Draw a horizontal bar for each name, the first at the top."""
    drawing = make_figure(height=3.0)
    axes = drawing.add_subplot()
    axes.barh(list(costs), list(costs.values()))
    axes.invert_yaxis()
    axes.set_xlabel(unit)
    save(drawing, path)


QUANTILES_HEAD: Final = "".join(f"{name:>22}" for name in QUANTILES)


def format_quantiles(quantiles: Mapping[str, Any]) -> str:
    """Return percentiles of `compute_quantiles`, us, below QUANTILES_HEAD; in brackets the median over blocks."""
    blocks = quantiles["blocks"]
    cells = (f"{format_microseconds(quantiles[q])} ({format_microseconds(blocks[q])})" for q in QUANTILES)
    return "".join(f"{cell:>22}" for cell in cells)


def format_realtime(settings: Mapping[str, bool]) -> str:
    return "  real time: " + ", ".join(f"{name} {'yes' if is_on else 'no'}" for name, is_on in settings.items())


def format_microseconds(seconds: float) -> str:
    return f"{seconds * 1e6:9.2f}"


def compile_c(source: Path, folder: Path, *flags: str) -> Path | None:
    """Compile a program in C into a folder; returns None if there is no C compiler."""
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        return None
    program = folder / source.stem
    subprocess.run([compiler, "-O2", "-o", str(program), str(source), *flags], check=True)
    return program
