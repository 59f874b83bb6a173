"""Text of the methods section, written from the facts of an experiment's file and of its sessions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

from softfinger.server.experiment.analysis import is_counted
from softfinger.server.experiment.journal import Entry
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.experiment.surveys import format_answers
from softfinger.server.experiment.trial_order import list_conditions, plan_trials


def write_methods(
    experiment: ExperimentFile,
    rows: Sequence[Entry],
    excluded: Mapping[str, str],
    starts: Sequence[Mapping[str, Any]],
    answers: Sequence[Entry] = (),
) -> list[str]:
    """Return the paragraphs of a methods section.

    starts   contents of the files about each start of a session (`about.json`)
    answers  rows of `surveys.survey_table`
    """
    paragraphs = [
        _describe_participants(experiment, rows, excluded, starts),
        _describe_apparatus(experiment, starts),
        _describe_task(experiment),
        _describe_procedure(experiment),
        _describe_design(experiment),
        _describe_surveys(experiment, answers),
        _describe_analysis(experiment),
    ]
    return [" ".join(sentences) for sentences in paragraphs if sentences]


def _describe_participants(
    experiment: ExperimentFile, rows: Sequence[Entry], excluded: Mapping[str, str], starts: Sequence[Mapping[str, Any]]
) -> list[str]:
    count = len({row["participant"] for row in rows})
    simulated = "simulated observer" if any(start.get("simulated") for start in starts) else "participant"
    text = [f"{_format_number(count, simulated)} took part."]
    if experiment.consent:
        text.append("Each gave informed consent before the first trial.")
    if excluded:
        text.append(
            f"{_format_number(len(excluded), simulated)} {'was' if len(excluded) == 1 else 'were'} excluded because of "
            "wrong answers to catch trials."
        )
    return text


def _describe_apparatus(experiment: ExperimentFile, starts: Sequence[Mapping[str, Any]]) -> list[str]:
    text = [f"Contact was rendered by softfinger {version('softfinger')} in the scene “{experiment.scene}”."]
    rendered = [start for start in starts if "device" in start]
    if rendered:
        devices = sorted({str(start["device"].get("name", "")) for start in rendered})
        rates = sorted({f"{start['rate_hz']:g}" for start in rendered})
        text.append(f"The device was {', '.join(devices)}, at {', '.join(rates)} Hz.")
        if experiment.screen.masking_noise != "none":
            text.append(f"{experiment.screen.masking_noise.capitalize()} noise masked the sound of the device.")
    else:
        text.append("No device was used: the answers are simulated without rendering.")
    return text


def _describe_task(experiment: ExperimentFile) -> list[str]:
    task, trial = experiment.task, experiment.trial
    if task.kind == "compare":
        change = "reference × (1 + level)" if task.more == "up" else "reference / (1 + level)"
        text = [
            f"In each trial two touches of {trial.touch_s:g} s were compared. One had the reference value "
            f"{task.reference:g} of {task.parameter}, the other the value {change}, in random order.",
            f"The question was “{task.question}”.",
        ]
        if experiment.confidence is not None:
            low, high = experiment.confidence.scale
            text.append(f"After each answer, confidence was rated from {low} to {high}.")
        return text
    if task.kind == "rate":
        scale = "by a number above 0" if task.scale is None else f"from {task.scale[0]} to {task.scale[1]}"
        return [
            f"In each trial a touch of {trial.touch_s:g} s had a level of {task.parameter} and was rated {scale}.",
            f"The question was “{task.question}”.",
        ]
    return [
        f"In each trial a movement to a target was timed, at most {trial.touch_s:g} s, at a level of {task.parameter}."
    ]


def _describe_procedure(experiment: ExperimentFile) -> list[str]:
    procedure = experiment.procedure
    match procedure.kind:
        case "staircase":
            starts = procedure.starts or (procedure.start,)
            is_repeated = len(starts) > 1
            text = [
                f"Levels were chosen by {f'{len(starts)} interleaved staircases' if is_repeated else 'a staircase'} of "
                f"{procedure.trials} trials {'together ' if is_repeated else ''}per condition, starting at "
                f"{_list([f'{start:g}' for start in starts])}: {_format_number(procedure.down, 'right answer')} in a "
                f"row decreased the level by a factor of {procedure.step:g} (its square before the second reversal) "
                f"and a wrong one increased it (Levitt 1971), within {procedure.smallest:g} and {procedure.largest:g}."
            ]
        case "questplus":
            text = [
                f"Levels were chosen from {_list([f'{level:g}' for level in procedure.levels])} by QUEST+ (Watson "
                f"2017), {procedure.trials} trials per condition."
            ]
        case _:
            text = [
                f"The levels {_list([f'{level:g}' for level in procedure.levels])} were presented "
                f"{_format_number(procedure.repetitions, 'time')} each per condition in random order."
            ]
    if experiment.catch is not None:
        catch = experiment.catch
        text.append(f"Catch trials with level {catch.level:g} were added at a rate of {catch.rate:.0%}.")
        if catch.min_right:
            text.append(f"Participants with fewer than {catch.min_right:.0%} of them right were excluded.")
    return text


def _describe_design(experiment: ExperimentFile) -> list[str]:
    design, trials = experiment.design, plan_trials(experiment, 1)
    text = []
    if experiment.factor:
        factors = [f"{factor.name} ({_list([str(level) for level in factor.levels])})" for factor in experiment.factor]
        count = len(list_conditions(experiment))
        order = {
            "random": "their trials were mixed in random order",
            "latin-square": "each had a block, in an order balanced by a Latin square (Williams 1949)",
            "given": "each had a block, in the same order for all",
        }[design.order]
        text.append(f"The {count} conditions were all combinations of {_list(factors)}; {order}.")
    text.append(f"A session had {len(trials)} trials, of which {design.practice} were practice.")
    if experiment.task.kind == "compare":
        of = "all trials" if design.test_first == "balanced" else "the trials of each condition and level"
        if design.test_first != "balanced" and experiment.procedure.kind != "constant":
            of = "the trials of each condition and staircase"
        text.append(f"The reference came second in half of {of}.")
    if design.break_every:
        text.append(f"There was a break after each {design.break_every} trials.")
    return text


def _describe_surveys(experiment: ExperimentFile, answers: Sequence[Entry]) -> list[str]:
    text, when = [], {
        "before": "before the first trial", "between": "after each block but the last", "after": "after the last trial"
    }  # fmt: skip
    for survey in experiment.survey:
        source = f" ({survey.reference})" if survey.reference else ""
        times = _list([when[at] for at in survey.at])
        text.append(f"The survey “{survey.title or survey.name}”{source} was answered {times}.")
        if survey.score == "mean":
            text.append("Its score is the unweighted mean of its ratings.")
        if survey.at == ("before",):  # describes the participants
            names = {question.name for question in survey.question if question.kind != "text"}
            sentences = [
                row for row in answers if row["survey"] == (survey.title or survey.name) and row["question"] in names
            ]
            if sentences:
                facts = [f"{row['question']} {format_answers(row)}" for row in sentences]
                text.append(f"Its answers were: {', '.join(facts)}.")
    return text


def _describe_analysis(experiment: ExperimentFile) -> list[str]:
    if experiment.task.kind == "compare":
        model = (
            "A Weibull function p = 1/2 + (1/2 - lapse) (1 - exp(-(level / threshold)^slope)) with lapse = "
            f"{experiment.observer.lapse:g} was fitted to the answers of each participant and condition; estimates are "
            "medians of the posterior with central 95 % intervals (Kuss, Jäkel and Wichmann 2005)."
        )
    else:
        model = (
            "A power law was fitted by least squares to the logarithms of answer and level, with Student's intervals."
        )
    return [
        model,
        "Means over participants are geometric, with Student's 95 % intervals; ratios of conditions are within "
        "participants.",
        "Each factor was tested by the likelihood ratio of models with and without it, with parameters for each "
        "participant (Wilks 1938).",
    ]


def count_trials(rows: Sequence[Entry]) -> tuple[int, int, int]:
    practice = sum(bool(row["practice"]) for row in rows)
    counted = sum(is_counted(row) for row in rows)
    return practice, len(rows) - practice - counted, counted


def _format_number(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _list(words: Sequence[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)
