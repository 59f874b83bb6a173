"""Figures of `softfinger accuracy`: Pareto fronts, convergence, the paper's experiment."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from softfinger.server.offline.figures import make_figure, save
from softfinger.tools.accuracy.cases import METHODS
from softfinger.tools.accuracy.front import find_front, group_by, select_standard
from softfinger.tools.accuracy.paper import MOTIONS, compute_exact_path, compute_method_path

COLUMNS: Final = 4
ORDER_SURFACES: Final = ("ellipsoid", "torus")
FLOOR_M: Final = 1e-18
"""Smallest error drawn, since a logarithmic axis has no zero."""
FRONT: Final = {"color": "0.8", "linewidth": 6, "solid_capstyle": "round"}
"""Wide grey line below the lines of the methods, visible even for a single point."""
PLOT_STRIDE: Final = 4
"""One of so many steps of the paper's paths is drawn."""


def choose_colour(method: str) -> str:
    return f"C{list(METHODS).index(method)}"


def make_panels(path: Path, names: Sequence[str], columns: int) -> tuple[Any, list[Any]]:
    rows = -(-len(names) // columns)
    drawing = make_figure(2.9 * columns + 0.6, 2.3 * rows + 0.8)
    axes_list = drawing.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).ravel()
    for axes, name in zip(axes_list, names, strict=False):
        axes.set_title(name, fontsize="medium")
    for axes in axes_list[len(names) :]:
        axes.set_axis_off()
    for number in range(max(len(names) - columns, 0), len(names)):
        axes_list[number].xaxis.set_tick_params(labelbottom=True)
    return drawing, list(axes_list[: len(names)])


def draw_fronts(result: dict[str, Any], path: Path) -> None:
    """Draw error against computing time, a panel for each surface: a line per method over the rates, and the front.

    Of two motions, the changing one is drawn, since the closed forms have no error at a constant rate.
    """
    rows = select_standard(result["trade"])
    motion = "changing" if any(row["motion"] == "changing" for row in rows) else "constant"
    surfaces = group_by((row for row in rows if row["motion"] == motion), "surface")
    groups = {str(name): group for (name,), group in surfaces}
    drawing, axes_list = make_panels(path, list(groups), min(COLUMNS, len(groups)))
    lines: dict[str, Any] = {}
    for axes, group in zip(axes_list, groups.values(), strict=True):
        chosen = find_front(group)
        points = [(row["ns_per_step"] / row["step_s"] * 1e-9, max(row["max_error_m"], FLOOR_M)) for row in chosen]
        (lines["Pareto front"],) = axes.loglog(*zip(*points, strict=True), **FRONT)
        for (method,), ladder in group_by(group, "method"):
            load = [row["ns_per_step"] / row["step_s"] * 1e-9 for row in ladder]
            error = [max(row["max_error_m"], FLOOR_M) for row in ladder]
            (lines[method],) = axes.loglog(load, error, color=choose_colour(method), linewidth=1)
    rates = span([row["rate_hz"] for row in rows])
    x = f"computing time, s per s of motion; {motion} rate, servo at {rates} Hz"
    label(drawing, axes_list, x, "largest error, m", lines)
    save(drawing, path)


def draw_orders(result: dict[str, Any], path: Path) -> None:
    """Draw error against step on surfaces without a closed form, with the slopes of orders 1, 2 and 4."""
    rows = select_standard(result["trade"])
    measured = {row["surface"] for row in rows}
    names = [name for name in ORDER_SURFACES if name in measured] or sorted(measured)[:2]
    groups = {
        f"{name}, {motion} rate": group
        for (name, motion), group in group_by(rows, "surface", "motion")
        if name in names
    }
    drawing, axes_list = make_panels(path, list(groups), min(2, len(groups)))
    lines: dict[str, Any] = {}
    for axes, group in zip(axes_list, groups.values(), strict=True):
        for (method,), ladder in group_by(group, "method"):
            steps = [row["step_s"] for row in ladder]
            error = [max(row["max_error_m"], FLOOR_M) for row in ladder]
            (lines[method],) = axes.loglog(steps, error, color=choose_colour(method), marker=".", linewidth=1)
        step = np.array([min(row["step_s"] for row in group), max(row["step_s"] for row in group)])
        for order, at in ((1, 1e-3), (2, 1e-4), (4, 1e-7)):
            slope = at * (step / step[1]) ** order
            (lines[f"slope {order}"],) = axes.loglog(step, slope, color="0.7", linestyle=(0, (order, 2)), linewidth=1)
        axes.set_ylim(1e-16, 1e-2)
    label(drawing, axes_list, "step, s", "largest error in a second, m", lines)
    save(drawing, path)


def draw_paper(result: dict[str, Any], path: Path) -> None:
    """Draw the paths of the paper's experiment for the reference and the methods, and their largest differences."""
    drawing = make_figure(9.0, 6.4)
    above, below = drawing.subplots(2, 2)
    lines: dict[str, Any] = {}
    for axes, bars, motion in zip(above, below, MOTIONS, strict=True):
        x, y, _ = 1e3 * compute_exact_path(motion)[::PLOT_STRIDE].T
        (lines["reference"],) = axes.plot(x, y, color="0.8", linewidth=4)
        for name in ("euler_zxz", "euler_zyx", "rotation_vector"):
            x, y, _ = 1e3 * compute_method_path(name, motion)[::PLOT_STRIDE].T
            (lines[name],) = axes.plot(x, y, color=choose_colour(name), linewidth=1)
        axes.set_title(f"axes of the {motion.replace('_', ' ')}", fontsize="medium")
        axes.set(xlabel="x, mm", ylabel="y, mm")
        rows = [row for row in result["paper"] if row["motion"] == motion]
        largest = [max(*row["max_error_mm"], FLOOR_M * 1e3) for row in rows]
        bars.barh([row["method"] for row in rows][::-1], largest[::-1], color="0.6")
        bars.axvline(0.004, color="k", linewidth=0.8, linestyle=":")
        bars.set(xscale="log", xlim=(1e-14, 10.0), xlabel="largest difference, mm (dotted: as published)")
    drawing.legend(lines.values(), lines.keys(), loc="outside lower center", ncols=len(lines), fontsize="small")
    save(drawing, path)


def label(drawing: Any, axes_list: Sequence[Any], x: str, y: str, lines: dict[str, Any]) -> None:
    """Set the axis labels of the drawing, few ticks, and a legend at the top."""
    from matplotlib.ticker import FuncFormatter, LogLocator

    drawing.supxlabel(x, fontsize="medium")
    drawing.supylabel(y, fontsize="medium")
    for axes in axes_list:
        axes.minorticks_off()
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(numticks=5))
            axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.0e}"))
            axis.set_tick_params(labelsize="small")
    drawing.legend(lines.values(), lines.keys(), loc="outside upper center", ncols=min(5, len(lines)), fontsize="small")


def span(values: Sequence[float]) -> str:
    return f"{min(values):g} to {max(values):g}" if min(values) < max(values) else f"{values[0]:g}"


FIGURES: Final[dict[str, Callable[[dict[str, Any], Path], None]]] = {
    "accuracy-paper.svg": draw_paper,
    "accuracy-pareto.svg": draw_fronts,
    "accuracy-convergence.svg": draw_orders,
}
"""Files that `--figures` writes."""
