"""Figures of the course of a session: staircases, confidence, and ratings of surveys."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from softfinger.server.experiment.analysis import Group, is_counted
from softfinger.server.experiment.figures import name_factors, plain_ticks, save, wrap_title
from softfinger.server.experiment.journal import Entry
from softfinger.server.experiment.schema import ExperimentFile


def draw_session(
    experiment: ExperimentFile, rows: Sequence[Entry], table: Sequence[Entry], groups: Sequence[Group], out: Path
) -> list[Path]:
    """Draw interleaved staircases, confidence and surveys, if the experiment has them; return the files."""
    import matplotlib.pyplot as plt  # after `figures.draw`, which has chosen the backend

    figures = {}
    if experiment.procedure.starts:
        figures["staircases"] = _draw_staircases(plt, [row for row in rows if is_counted(row)])
    if experiment.confidence is not None:
        figures["confidence"] = _draw_confidence(plt, experiment, groups)
    ratings = [row for row in table if not np.isnan(row["mean"])]
    if ratings:
        figures["surveys"] = _draw_surveys(plt, experiment, ratings)
    return save(figures, out)


def _draw_staircases(plt: Any, rows: Sequence[Entry]) -> Any:
    """Draw the levels of each staircase, a panel for each participant and condition."""
    panels = dict[tuple[str, str], list[Entry]]()
    for row in rows:
        panels.setdefault((row["participant"], row["condition"]), []).append(row)
    width = min(len(panels), 4)
    height = -(-len(panels) // width)
    figure, grid = plt.subplots(
        height, width, figsize=(3.0 * width, 2.6 * height), squeeze=False, sharey=True, layout="constrained"
    )
    for axes in grid.flat[len(panels) :]:
        axes.remove()
    for axes, ((participant, condition), own) in zip(grid.flat, panels.items(), strict=False):
        for number in sorted({row["staircase"] for row in own}):
            stairs = [(place, row) for place, row in enumerate(own, 1) if row["staircase"] == number]
            places, levels = [place for place, _ in stairs], [row["level"] for _, row in stairs]
            (line,) = axes.plot(places, levels, lw=1.0, label=f"staircase {number}")
            wrong = [(place, row["level"]) for place, row in stairs if not row["right"]]
            axes.scatter(*zip(*wrong, strict=True) if wrong else ((), ()), s=14, color=line.get_color(), marker="x")
        axes.set(yscale="log", title=f"{participant}, {condition}", xlabel="trial of the condition")
        axes.title.set_fontsize("small")
        plain_ticks(axes)
    grid[0, 0].set(ylabel="level (x: wrong answer)")
    grid[0, 0].legend(fontsize="x-small")
    return figure


def _draw_confidence(plt: Any, experiment: ExperimentFile, groups: Sequence[Group]) -> Any:
    """Draw the share of right answers at each mark of confidence, by condition."""
    assert experiment.confidence is not None
    figure, axes = plt.subplots(figsize=(5, 3.6), layout="constrained")
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
    axes.set(xlabel="confidence", title=wrap_title(experiment, groups[-1].participant))
    axes.set_xticks(range(low, high + 1))
    axes.legend(fontsize="small", title=name_factors(experiment))
    return figure


def _draw_surveys(plt: Any, experiment: ExperimentFile, ratings: Sequence[Entry]) -> Any:
    """Draw mean and standard deviation of each numeric question, by condition; a panel for each survey."""
    surveys = list(dict.fromkeys(row["survey"] for row in ratings))
    counts = [len({row["question"] for row in ratings if row["survey"] == survey}) for survey in surveys]
    figure, grid = plt.subplots(
        1, len(surveys), figsize=(2.0 + 1.1 * sum(counts), 3.6), squeeze=False, layout="constrained",
        width_ratios=[count + 1 for count in counts],
    )  # fmt: skip
    for axes, survey in zip(grid.flat, surveys, strict=True):
        own = [row for row in ratings if row["survey"] == survey]
        questions = list(dict.fromkeys(row["question"] for row in own))
        conditions = list(dict.fromkeys(row["condition"] for row in own))
        for k, condition in enumerate(conditions):
            shift = 0.2 * (k - 0.5 * (len(conditions) - 1))
            condition_rows = [row for row in own if row["condition"] == condition]
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
