"""Figures of an experiment: fits, forces, paths and durations by condition, and staircases, confidence and surveys."""

from __future__ import annotations

import logging
import re
import textwrap
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from softfinger.server.experiment.analysis import (
    ALL_PARTICIPANTS,
    AVERAGED_COLUMNS,
    Group,
    PowerLaw,
    format_fit,
    is_counted,
)
from softfinger.server.experiment.journal import Entry
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.offline.figures import FORMATS, make_figure, save
from softfinger.server.progress import show_progress

if TYPE_CHECKING:
    from matplotlib.axes import Axes

log: Final = logging.getLogger(__name__)

LABELS: Final = {
    "peak_force_n": "peak force (N)",
    "mean_force_n": "mean force (N)",
    "path_m": "path (m)",
    "duration_s": "duration (s)",
}


def draw(experiment: ExperimentFile, groups: Sequence[Group], out: Path) -> list[Path]:
    """Draw the fits and AVERAGED_COLUMNS, if any, and return the files; raises ConfigError without matplotlib."""
    participants = list(dict.fromkeys(group.participant for group in groups))
    main_participant = ALL_PARTICIPANTS if ALL_PARTICIPANTS in participants else participants[0]
    figures = {"fit": make_figure(6.0, 4.0)}
    axes = figures["fit"].subplots()
    for group in groups:
        (_draw_power_law if isinstance(group.fit, PowerLaw) else _draw_psychometric)(
            axes, group, is_faint=group.participant != main_participant
        )
    axes.set(xscale="log", title=_wrap_title(experiment, main_participant), xlabel=experiment.task.parameter)
    if experiment.task.kind == "compare":
        axes.set(xlabel="difference, as a share of the reference", ylabel="share of right answers", ylim=(0.0, 1.02))
    else:
        axes.set(yscale="log", ylabel="duration (s)" if experiment.task.kind == "trace" else "answer")
    _label_ticks(axes)
    axes.legend(fontsize="small", title=name_factors(experiment))
    shown_groups = [group for group in groups if group.participant == main_participant]
    if any(group.means for group in shown_groups):
        figures["felt"] = make_figure(11.0, 3.2)
        for axes, name in zip(figures["felt"].subplots(1, len(AVERAGED_COLUMNS)), AVERAGED_COLUMNS, strict=True):
            _draw_means(axes, shown_groups, name)
    return _save(figures, out)


def draw_session(
    experiment: ExperimentFile, rows: Sequence[Entry], table: Sequence[Entry], groups: Sequence[Group], out: Path
) -> list[Path]:
    """Draw interleaved staircases, confidence and surveys, if the experiment has them; return the files."""
    figures = {}
    if experiment.procedure.starts:
        figures["staircases"] = _draw_staircases([row for row in rows if is_counted(row)])
    if experiment.confidence is not None:
        figures["confidence"] = _draw_confidence(experiment, groups)
    ratings = [row for row in table if not np.isnan(row["mean"])]
    if ratings:
        figures["surveys"] = _draw_surveys(experiment, ratings)
    return _save(figures, out)


def _draw_staircases(rows: Sequence[Entry]) -> Any:
    """Draw the levels of each staircase, a panel for each participant and condition."""
    panels = dict[tuple[str, str], list[Entry]]()
    for row in rows:
        panels.setdefault((row["participant"], row["condition"]), []).append(row)
    width = min(len(panels), 4)
    height = -(-len(panels) // width)
    figure = make_figure(3.0 * width, 2.6 * height)
    grid = figure.subplots(height, width, squeeze=False, sharey=True)
    for axes in grid.flat[len(panels) :]:
        axes.remove()
    for axes, ((participant, condition), group_rows) in zip(grid.flat, panels.items(), strict=False):
        for number in sorted({row["staircase"] for row in group_rows}):
            stairs = [(place, row) for place, row in enumerate(group_rows, 1) if row["staircase"] == number]
            places, levels = [place for place, _ in stairs], [row["level"] for _, row in stairs]
            (line,) = axes.plot(places, levels, lw=1.0, label=f"staircase {number}")
            wrong = [(place, row["level"]) for place, row in stairs if not row["right"]]
            axes.scatter(*zip(*wrong, strict=True) if wrong else ((), ()), s=14, color=line.get_color(), marker="x")
        axes.set(yscale="log", title=f"{participant}, {condition}", xlabel="trial of the condition")
        axes.title.set_fontsize("small")
        _label_ticks(axes)
    grid[0, 0].set(ylabel="level (x: wrong answer)")
    grid[0, 0].legend(fontsize="x-small")
    return figure


def _draw_confidence(experiment: ExperimentFile, groups: Sequence[Group]) -> Any:
    """Draw the share of right answers at each mark of confidence, by condition."""
    assert experiment.confidence is not None
    figure = make_figure(5.0, 3.6)
    axes = figure.subplots()
    for group in groups:
        if group.participant != groups[-1].participant:
            continue
        by_mark = dict[float, list[bool]]()
        for row in group.rows:
            by_mark.setdefault(row["confidence"], []).append(row["right"])
        marks = sorted(by_mark)
        shares = [np.mean(by_mark[mark]) for mark in marks]
        (line,) = axes.plot(marks, shares, label=group.condition)
        axes.scatter(marks, shares, [8.0 * np.sqrt(len(by_mark[mark])) for mark in marks], color=line.get_color())
    low, high = experiment.confidence.scale
    axes.axhline(0.5, color="0.7", lw=0.8)
    axes.set(xlim=(low - 0.3, high + 0.3), ylim=(0.0, 1.03), ylabel="share of right answers")
    axes.set(xlabel="confidence", title=_wrap_title(experiment, groups[-1].participant))
    axes.set_xticks(range(low, high + 1))
    axes.legend(fontsize="small", title=name_factors(experiment))
    return figure


def _draw_surveys(experiment: ExperimentFile, ratings: Sequence[Entry]) -> Any:
    """Draw mean and standard deviation of each numeric question, by condition; a panel for each survey."""
    surveys = list(dict.fromkeys(row["survey"] for row in ratings))
    counts = [len({row["question"] for row in ratings if row["survey"] == survey}) for survey in surveys]
    figure = make_figure(2.0 + 1.1 * sum(counts), 3.6)
    grid = figure.subplots(1, len(surveys), squeeze=False, width_ratios=[count + 1 for count in counts])
    for axes, survey in zip(grid.flat, surveys, strict=True):
        group_rows = [row for row in ratings if row["survey"] == survey]
        questions = list(dict.fromkeys(row["question"] for row in group_rows))
        conditions = list(dict.fromkeys(row["condition"] for row in group_rows))
        for k, condition in enumerate(conditions):
            shift = 0.2 * (k - 0.5 * (len(conditions) - 1))
            condition_rows = [row for row in group_rows if row["condition"] == condition]
            axes.errorbar(
                [questions.index(row["question"]) + shift for row in condition_rows],
                [row["mean"] for row in condition_rows],
                np.nan_to_num([row["sd"] for row in condition_rows]),
                fmt="o", ms=4, capsize=3, label=condition or None,
            )  # fmt: skip
        axes.set_xticks(range(len(questions)), questions, rotation=30, ha="right")
        axes.set(title=survey, ylabel="mean and standard deviation", xlim=(-0.5, len(questions) - 0.5))
        if any(conditions):
            axes.legend(fontsize="small", title=name_factors(experiment))
    return figure


def _wrap_title(experiment: ExperimentFile, participant: str) -> str:
    title = textwrap.fill(experiment.title, 50).replace("$", r"\$")  # matplotlib: $ begins a formula
    return f"{title}\n{participant}"


def name_factors(experiment: ExperimentFile) -> str | None:
    return ", ".join(factor.name for factor in experiment.factor) or None


def _label_ticks(axes: Axes) -> None:
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
        values = [row[name] for row in group.rows if name in row]
        if values:
            spread = np.linspace(-0.15, 0.15, len(values))
            axes.plot(index + spread, values, ".", ms=3, alpha=0.5)
            axes.plot(index, np.mean(values), "k_", ms=16)
    axes.set_xticks(range(len(groups)), [group.condition for group in groups])
    axes.set(ylabel=LABELS[name], xlim=(-0.5, len(groups) - 0.5))
    axes.set_ylim(bottom=0.0)


def _save(figures: Mapping[str, Any], out: Path) -> list[Path]:
    """Write figures by the name of their file, in all FORMATS; return the files."""
    paths = []
    with (
        show_progress("drawing", len(FORMATS) * len(figures)) as update,
        warnings.catch_warnings(record=True) as caught,
    ):
        warnings.simplefilter("always")
        for name, figure in figures.items():
            for suffix in FORMATS:
                paths.append((out / name).with_suffix(suffix))
                save(figure, paths[-1])
                update(len(paths))
    _report_warnings(caught)
    return paths


def _report_warnings(caught: Sequence[warnings.WarningMessage]) -> None:
    """Report characters that the font lacks in one line; ignore that a legend takes long on a slow machine."""
    missing = dict[str, None]()
    for warning in caught:
        text = str(warning.message)
        if glyph := re.match(r"Glyph (\d+)", text):
            missing[chr(int(glyph[1]))] = None
        elif not text.startswith("Creating legend"):
            warnings.warn_explicit(warning.message, warning.category, warning.filename, warning.lineno)
    if missing:
        remedy = "set font.family in matplotlibrc to a font that has them"
        log.warning("the font of the figures lacks the characters %s: %s", "".join(missing)[:40], remedy)
