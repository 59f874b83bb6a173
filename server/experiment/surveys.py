"""Answers to surveys: tables by question and condition, and differences of scores between conditions."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from typing import Any

import numpy as np

from softfinger.server.experiment.comparison import Effect, compute_level_differences
from softfinger.server.experiment.journal import Entry
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.experiment.schema_parts import Survey


def survey_table(experiment: ExperimentFile, answers: Sequence[Entry], excluded: Collection[str] = ()) -> list[Entry]:
    """Return a row for each question by condition: number of answers, mean and standard deviation, or the choices.

    A survey with the score `mean` has one more row, the mean of its likert questions of each participant and time.
    """
    table = []
    for survey in experiment.survey:
        rows = [row for row in answers if row["survey"] == survey.name and row["participant"] not in excluded]
        scores = _compute_scores(survey, rows)
        rows += [{"question": "mean", "condition": key[2], "answer": value} for key, value in scores.items()]
        for question in [*(question.name for question in survey.question), *(["mean"] if scores else [])]:
            for condition in dict.fromkeys(row["condition"] for row in rows):
                values = [row["answer"] for row in rows if (row["question"], row["condition"]) == (question, condition)]
                if values:
                    table.append(
                        {
                            "survey": survey.title or survey.name,
                            "question": question,
                            "condition": condition or "",
                            "answers": len(values),
                        }
                        | _summarise(values)
                    )
    return table


def compare_scores(
    experiment: ExperimentFile, answers: Sequence[Entry], excluded: Collection[str] = ()
) -> list[tuple[str, Effect]]:
    """Return survey and difference of its score between the levels of each factor, for surveys after blocks."""
    effects = []
    for survey in experiment.survey:
        rows = [row for row in answers if row["survey"] == survey.name and row["participant"] not in excluded]
        scores = {
            (participant, at): score
            for (participant, _, at), score in _compute_scores(survey, rows).items()
            if at is not None
        }
        effects += [(survey.title or survey.name, effect) for effect in compute_level_differences(experiment, scores)]
    return effects


def _compute_scores(survey: Survey, answers: Sequence[Entry]) -> dict[tuple[str, int, str | None], float]:
    """Return the score by participant, block and condition. A mean of fewer ratings is another quantity: left out."""
    likert = [question.name for question in survey.question if question.kind == "likert"]
    ratings = dict[tuple[str, int, str | None], list[float]]()
    for row in answers if survey.score == "mean" else ():
        if row["question"] in likert:
            ratings.setdefault((row["participant"], row["block"], row["condition"]), []).append(row["answer"])
    return {key: float(np.mean(values)) for key, values in ratings.items() if len(values) == len(likert)}


def _summarise(answers: Sequence[Any]) -> dict[str, Any]:
    if all(isinstance(answer, int | float) for answer in answers):
        deviation = float(np.std(answers, ddof=1)) if len(answers) > 1 else math.nan
        return {"mean": float(np.mean(answers)), "sd": deviation, "given": ""}
    counts = dict[str, int]()
    for answer in answers:
        counts[str(answer)] = counts.get(str(answer), 0) + 1
    return {"mean": math.nan, "sd": math.nan, "given": "; ".join(f"{text}: {count}" for text, count in counts.items())}


def format_answers(row: Entry) -> str:
    """Return mean and standard deviation of a row of `survey_table`, or its choices with their numbers."""
    if math.isnan(row["mean"]):
        return str(row["given"])
    return f"{row['mean']:.1f}" + ("" if math.isnan(row["sd"]) else f" ± {row['sd']:.1f}")
