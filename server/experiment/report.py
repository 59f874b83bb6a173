"""Report of an experiment: one HTML file with design, exclusions, estimates, model comparison, methods and figures."""

from __future__ import annotations

import base64
import html
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import msgspec

from softfinger.config.errors import ConfigError
from softfinger.server.experiment.analysis import (
    Group,
    catch_shares,
    find_excluded_participants,
    format_fit,
    format_interval,
    is_counted,
)
from softfinger.server.experiment.comparison import Effect, compare_levels, compare_models, estimate_population
from softfinger.server.experiment.figures import name_factors
from softfinger.server.experiment.journal import JSON_ERRORS, RESTORE_REMEDY, Entry, read
from softfinger.server.experiment.methods import count_trials, write_methods
from softfinger.server.experiment.psychometric import compute_probability
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.experiment.surveys import format_answers
from softfinger.server.experiment.trial_order import list_conditions, plan_trials
from softfinger.server.progress import show_progress

STYLE: Final = (
    "body{font:16px/1.5 sans-serif;max-width:60em;margin:2em auto;padding:0 1em;color:#222}"
    "table{border-collapse:collapse;margin:1em 0}td,th{border-bottom:1px solid #ccc;padding:.2em .8em;text-align:left;"
    "vertical-align:top}figure{margin:1em 0}img{max-width:100%;display:block}figcaption{color:#555}"
)
CAPTIONS: Final = {
    "fit": "Answers by level, with the fits of each condition and their 95 % bands; grey: fits of single participants.",
    "felt": "Force, path and duration of the touches in each condition; dots: trials, lines: means.",
    "staircases": "Level of each trial of the staircases, in the order of the session; crosses: wrong answers.",
    "confidence": "Right answers by confidence; the areas of the dots grow with the number of trials.",
    "surveys": "Mean and standard deviation of the answers to each question.",
}
PAGE: Final = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="default-src 'none'; img-src data:; style-src 'unsafe-inline'">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<h1>{title}</h1>
{body}
</body>
</html>
"""


def write_report(
    experiment: ExperimentFile,
    rows: Sequence[Entry],
    groups: Sequence[Group],
    surveys: tuple[Sequence[Entry], Sequence[tuple[str, Effect]]],
    root: Path,
    figures: Sequence[Path],
) -> str:
    """Return the report as HTML. All texts of the experiment and of participants are escaped.

    surveys  rows of `surveys.survey_table`, and effects of `surveys.compare_scores`
    figures  files of figures; the PNG ones are embedded
    """
    excluded = find_excluded_participants(experiment, rows)
    sections: dict[str, Callable[[], str]] = {
        "Design": lambda: _report_design(experiment),
        "Participants and exclusions": lambda: _report_exclusions(experiment, rows, excluded, root),
        "Estimates": lambda: _report_estimates(experiment, groups, excluded),
        "Models with and without a factor": lambda: _report_models(experiment, rows, excluded),
        "Surveys": lambda: _report_surveys(*surveys),
        "Figures": lambda: "".join(map(_format_image, (path for path in figures if path.suffix == ".png"))),
        "Methods": lambda: "".join(
            map(_format_paragraph, write_methods(experiment, rows, excluded, _load_starts(root), surveys[0]))
        ),
    }
    parts = []
    with show_progress("writing the report", len(sections)) as update:
        for number, (heading, write_section) in enumerate(sections.items(), 1):
            if content := write_section():
                parts.append(f"<h2>{heading}</h2>\n{content}")
            update(number)
    body = "\n".join(parts)
    return PAGE.format(title=html.escape(experiment.title), style=STYLE, body=body)


def _report_design(experiment: ExperimentFile) -> str:
    task, procedure, design = experiment.task, experiment.procedure, experiment.design
    levels = procedure.levels or procedure.starts or (procedure.start,)
    facts = {
        "question": task.question,
        "task": task.kind,
        "parameter": task.parameter,
        "reference": "" if task.reference is None else f"{task.reference:g}",
        "procedure": procedure.kind,
        "levels" if procedure.levels else "starts": ", ".join(f"{level:g}" for level in levels),
        "factors": "; ".join(f"{factor.name}: {', '.join(map(str, factor.levels))}" for factor in experiment.factor),
        "conditions": "; ".join(condition.name for condition in list_conditions(experiment)),
        "order, seed": f"{design.order}, {design.seed}",
        "trials of a session": str(len(plan_trials(experiment, 1))),
        "scene, rig": f"{experiment.scene}, {experiment.rig}",
    }
    return _format_table((), [pair for pair in facts.items() if pair[1]])


def _report_exclusions(
    experiment: ExperimentFile, rows: Sequence[Entry], excluded: Mapping[str, str], root: Path
) -> str:
    caught, is_comparison = catch_shares(rows), experiment.task.kind == "compare"
    journals = {path.parent.name: read(path) for path in sorted(root.glob("sub-*/sub-*_journal.jsonl"))}
    lines = []
    for participant, entries in journals.items():
        group_rows = [row for row in rows if row["participant"] == participant]
        practice, catch, counted = count_trials(group_rows)
        right = f"{caught[participant][0]} of {catch}" if participant in caught else "none"
        first = [row["answer"] == "first" for row in group_rows if is_counted(row)] if is_comparison else []
        kinds = {entry["kind"] for entry in entries}
        why = excluded.get(participant, "no")
        if "consent" in kinds and not any(entry.get("agreed") for entry in entries):
            why = "did not agree"
        elif "finished" not in kinds:
            why += "; the session is not finished"
        share = [f"{sum(first) / len(first):.0%}" if first else "none"] if is_comparison else []
        lines.append((participant, str(counted), str(practice), right, *share, why))
    bias = ["answered “first”"] if is_comparison else []
    return _format_table(("participant", "analysed trials", "practice", "right catch trials", *bias, "excluded"), lines)


def _report_estimates(experiment: ExperimentFile, groups: Sequence[Group], excluded: Mapping[str, str]) -> str:
    if experiment.task.kind == "compare":
        share = float(compute_probability(1.0, 1.0, 1.0, lapse=experiment.observer.lapse))
        value = "value / reference - 1" if experiment.task.more == "up" else "reference / value - 1"
        quantity = f"A threshold is the level, {value}, at which {100.0 * share:.0f} % of the answers are right."
    else:
        quantity = "An estimate is the answer at the geometric mean of the levels."
    ratios = _format_effects(
        [(effect.factor, effect) for effect in compare_levels(experiment, groups, excluded)], "ratio"
    )
    population = _format_table(
        (_format_condition_head(experiment), "participants", "geometric mean (95 % interval)"),
        [
            (estimate.condition, str(estimate.participants), format_interval(estimate.mean, estimate.interval_95))
            for estimate in estimate_population(groups, excluded)
        ],
    )
    group_rows = [(group.participant, group.condition, str(group.trials), format_fit(group.fit)) for group in groups]
    fits = _format_table(
        ("participant", _format_condition_head(experiment), "trials", "estimate (95 % interval)"), group_rows
    )
    return _format_paragraph(quantity) + population + ratios + fits


def _format_condition_head(experiment: ExperimentFile) -> str:
    factors = name_factors(experiment)
    return f"condition ({factors})" if factors else "condition"


def _report_models(experiment: ExperimentFile, rows: Sequence[Entry], excluded: Mapping[str, str]) -> str:
    comparisons = compare_models(experiment, rows, excluded)
    note = "The AIC difference is that without the factor less that with it: above 0 favours the factor."
    return "" if not comparisons else _format_paragraph(note) + _format_table(
        ("factor", "parameters with, without", "log likelihood with, without", "likelihood ratio", "AIC difference"),
        [
            (
                comparison.factor,
                f"{comparison.parameters[0]}, {comparison.parameters[1]}",
                f"{comparison.log_likelihood[0]:.2f}, {comparison.log_likelihood[1]:.2f}",
                f"χ²({comparison.freedom}) = {comparison.chi_squared:.2f}, {format_p(comparison.p_value)}",
                f"{comparison.aic_difference:.2f}",
            )
            for comparison in comparisons
        ],
    )  # fmt: skip


def format_p(value: float) -> str:
    return "p < 0.001" if value < 0.001 else f"p = {value:.3f}"


def _report_surveys(table: Sequence[Entry], effects: Sequence[tuple[str, Effect]]) -> str:
    if not table:
        return ""
    lines = [
        (row["survey"], row["question"], row["condition"], str(row["answers"]), format_answers(row)) for row in table
    ]
    head = ("survey", "question", "condition", "answers", "mean ± standard deviation, or answers")
    return _format_table(head, lines) + _format_effects(
        [(f"{survey}: {effect.factor}", effect) for survey, effect in effects], "difference"
    )


def _format_effects(effects: Sequence[tuple[str, Effect]], kind: str) -> str:
    """Return a table of effects of factors, each with a name; `kind` is ratio or difference."""
    joint = {"ratio": "to", "difference": "less"}[kind]
    lines = [
        (name, f"{effect.level} {joint} {effect.baseline}", str(effect.participants),
         format_interval(effect.value, effect.interval_95))
        for name, effect in effects
    ]  # fmt: skip
    head = ("factor", f"{kind} within participants", "participants", "mean (95 % interval)")
    return _format_table(head, lines) if lines else ""


def _load_starts(root: Path) -> list[dict[str, Any]]:
    """Return the data of each start of a session, `simulated` for dry runs; raises ConfigError if damaged."""
    starts = []
    for path in sorted(root.glob("sub-*/sub-*_run-*_about.json")):
        journal = read(path.parent / f"{path.parent.name}_journal.jsonl")
        is_simulated = any(entry["kind"] == "started" and entry["dry_run"] for entry in journal)
        try:
            starts.append(msgspec.json.decode(path.read_bytes(), type=dict) | {"simulated": is_simulated})
        except JSON_ERRORS as error:
            raise ConfigError(f"{path}: is damaged: {error}: {RESTORE_REMEDY}") from error
    return starts


def _format_table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    lines = ["<tr>" + "".join(f"<th>{html.escape(cell)}</th>" for cell in head) + "</tr>"] if head else []
    lines += ["<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows]
    return "<table>\n" + "\n".join(lines) + "\n</table>\n"


def _format_paragraph(text: str) -> str:
    return f"<p>{html.escape(text)}</p>\n"


def _format_image(path: Path) -> str:
    data, caption = base64.b64encode(path.read_bytes()).decode(), html.escape(CAPTIONS[path.stem])
    return (
        f'<figure><img alt="{path.stem}" src="data:image/png;base64,{data}">'
        f"<figcaption>{caption}</figcaption></figure>\n"
    )
