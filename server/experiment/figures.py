"""Figures of an experiment by condition: psychometric functions or power laws, and forces, paths and durations."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from softfinger.config.errors import ConfigError
from softfinger.server.experiment.analysis import ALL_PARTICIPANTS, AVERAGED_COLUMNS, Group, PowerLaw, format_fit
from softfinger.server.experiment.journal import Entry
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.progress import progress

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SUFFIXES: Final = ("png", "svg")
LABELS: Final = {
    "peak_force_n": "peak force (N)",
    "mean_force_n": "mean force (N)",
    "path_m": "path (m)",
    "duration_s": "duration (s)",
}


def draw(experiment: ExperimentFile, groups: Sequence[Group], out: Path) -> list[Path]:
    """Draw the fits, and the columns in AVERAGED_COLUMNS if there are any; return the files."""
    try:
        import matplotlib

        matplotlib.use("agg")
        import matplotlib.pyplot as plt
    except ImportError as error:
        raise ConfigError(f"figures need matplotlib ({error}): pip install 'softfinger[plots]'") from error
    participants = list(dict.fromkeys(group.participant for group in groups))
    main_participant = ALL_PARTICIPANTS if ALL_PARTICIPANTS in participants else participants[0]
    plt.rcParams["svg.hashsalt"] = "softfinger"  # same file for the same answers
    figure, axes = plt.subplots(figsize=(6, 4), layout="constrained")
    for group in groups:
        (_draw_power_law if isinstance(group.fit, PowerLaw) else _draw_psychometric)(
            axes, group, is_faint=group.participant != main_participant
        )
    axes.set(xscale="log", title=wrap_title(experiment, main_participant), xlabel=_level(experiment))
    if experiment.task.kind == "compare":
        axes.set(ylabel="share of right answers", ylim=(0.0, 1.02))
    else:
        axes.set(yscale="log", ylabel="duration (s)" if experiment.task.kind == "trace" else "answer")
    plain_ticks(axes)
    axes.legend(fontsize="small", title=name_factors(experiment))
    figures = {"fit": figure}
    shown_groups = [group for group in groups if group.participant == main_participant]
    if any(group.means for group in shown_groups):
        figures["felt"], all_axes = plt.subplots(1, len(AVERAGED_COLUMNS), figsize=(11, 3.2), layout="constrained")
        for axes, name in zip(all_axes, AVERAGED_COLUMNS, strict=True):
            _draw_means(axes, shown_groups, name)
    return save(figures, out)


def wrap_title(experiment: ExperimentFile, participant: str) -> str:
    return f"{textwrap.fill(experiment.title, 50)}\n{participant}"


def name_factors(experiment: ExperimentFile) -> str | None:
    return ", ".join(factor.name for factor in experiment.factor) or None


def plain_ticks(axes: Axes) -> None:
    """Label logarithmic axes with decimal numbers; matplotlib uses powers of ten."""
    from matplotlib.ticker import LogFormatter

    class Plain(LogFormatter):
        """Formatter that labels the same ticks as its base class, with decimal numbers."""

        def __call__(self, x: float, pos: int | None = None) -> str:
            return f"{x:g}" if super().__call__(x, pos) else ""

    for axis, scale in ((axes.xaxis, axes.get_xscale()), (axes.yaxis, axes.get_yscale())):
        if scale == "log":
            axis.set_major_formatter(Plain())
            axis.set_minor_formatter(Plain(minor_thresholds=(2.0, 0.4)))


def _level(experiment: ExperimentFile) -> str:
    task = experiment.task
    return "difference, as a share of the reference" if task.kind == "compare" else task.parameter


def _draw_psychometric(axes: Axes, group: Group, is_faint: bool) -> None:
    fit: Any = group.fit
    x, chance, low, high = fit.curve.T
    if is_faint:
        axes.plot(x, chance, color="0.75", lw=0.8)
        return
    (line,) = axes.plot(x, chance, label=_label(group))
    axes.fill_between(x, low, high, color=line.get_color(), alpha=0.2, lw=0)
    levels, index = np.unique([row["level"] for row in group.rows], return_inverse=True)
    right, count = np.bincount(index, [row["right"] for row in group.rows]), np.bincount(index)
    axes.scatter(levels, right / count, 8.0 * np.sqrt(count), color=line.get_color())


def _label(group: Group) -> str:
    return format_fit(group.fit) if group.condition == "all" else f"{group.condition}: {format_fit(group.fit)}"


def _draw_power_law(axes: Axes, group: Group, is_faint: bool) -> None:
    fit: Any = group.fit
    levels = np.array([row["level"] for row in group.rows])
    x = np.geomspace(levels.min(), levels.max(), 50)
    y = fit.scale * x ** np.nan_to_num(fit.exponent)
    if is_faint:
        axes.plot(x, y, color="0.75", lw=0.8)
        return
    (line,) = axes.plot(x, y, label=_label(group))
    answer_margin = np.abs(np.subtract(fit.answer_95, fit.answer))[:, None]
    axes.errorbar(fit.middle, fit.answer, answer_margin, color=line.get_color(), capsize=4)
    axes.scatter(levels, [row["answer"] for row in group.rows], 10.0, color=line.get_color(), alpha=0.4)


def _draw_means(axes: Axes, groups: Sequence[Group], name: str) -> None:
    """Draw the values of all trials of each condition, and their mean."""
    for index, group in enumerate(groups):
        values = _values(group.rows, name)
        if values:
            spread = np.linspace(-0.15, 0.15, len(values))
            axes.plot(index + spread, values, ".", ms=3, alpha=0.5)
            axes.plot(index, np.mean(values), "k_", ms=16)
    axes.set_xticks(range(len(groups)), [group.condition for group in groups])
    axes.set(ylabel=LABELS[name], xlim=(-0.5, len(groups) - 0.5))
    axes.set_ylim(bottom=0.0)


def _values(rows: Sequence[Entry], name: str) -> list[float]:
    return [row[name] for row in rows if name in row]


def save(figures: Mapping[str, Any], out: Path) -> list[Path]:
    """Write figures by the name of their file, as PNG and SVG, and close them; return the files."""
    import matplotlib.pyplot as plt  # after `draw`, which has chosen the backend

    paths = []
    with progress("drawing", len(SUFFIXES) * len(figures)) as update:
        for name, figure in figures.items():
            for suffix in SUFFIXES:
                paths.append((out / name).with_suffix(f".{suffix}"))
                figure.savefig(paths[-1], dpi=150, metadata={"Date": None} if suffix == "svg" else None)
                update(len(paths))
            plt.close(figure)
    return paths
