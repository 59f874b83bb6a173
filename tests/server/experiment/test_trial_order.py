"""Design of an experiment: conditions, orders and configuration errors."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from typing import Any

import pytest

from softfinger.config.errors import ConfigError
from softfinger.server.experiment.experiment import Experiment
from softfinger.server.experiment.interfaces import Progress
from softfinger.server.experiment.schema import ExperimentFile
from softfinger.server.experiment.session import number_blocks
from softfinger.server.experiment.trial_order import list_conditions, make_williams_row, plan_trials

pytestmark = pytest.mark.plain

STIFFNESS = "object.table.material.stiffness_n_per_m"


def make_tables(**tables: Any) -> dict[str, Any]:
    task = {"kind": "compare", "parameter": STIFFNESS, "reference": 500.0, "question": "Which was stiffer?"}
    procedure = {"kind": "constant", "levels": [0.1, 0.2, 0.4], "repetitions": 4}
    factor = {"name": "damping", "parameter": "object.table.material.damping_ns_per_m", "levels": [0.0, 1.0, 2.0]}
    defaults = {"title": "small", "scene": "paper-plane", "task": task, "procedure": procedure, "factor": [factor]}
    return defaults | {"design": {"seed": 5}} | tables


def make_file(**tables: Any) -> ExperimentFile:
    return Experiment(make_tables(**tables)).file


def test_all_combinations_occur_equally_often() -> None:
    both = [*make_tables()["factor"], {"name": "radius", "parameter": "fingertip.radius_m", "levels": [0.008, 0.01]}]
    experiment = make_file(factor=both)
    assert len(list_conditions(experiment)) == 6
    count = Counter((trial.condition, trial.level) for trial in plan_trials(experiment, 1))
    assert len(count) == 18 and set(count.values()) == {4}


def test_the_order_depends_on_seed_and_participant() -> None:
    trials = plan_trials(make_file(), 1)
    assert plan_trials(make_file(), 1) == trials
    assert plan_trials(make_file(), 2) != trials and plan_trials(make_file(design={"seed": 6}), 1) != trials


def test_the_reference_comes_first_as_often_as_second() -> None:
    assert sum(trial.test_first for trial in plan_trials(make_file(), 3)) == 18


@pytest.mark.parametrize("count", [1, 2, 3, 4, 5, 6, 7, 8])
def test_a_latin_square_is_balanced(count: int) -> None:
    """Each condition occurs equally often at each position and after each other condition (Williams 1949)."""
    rows = [make_williams_row(count, row) for row in range(count * (1 + count % 2))]
    for place in range(count):
        assert len(set(Counter(row[place] for row in rows).values())) == 1
    follows = Counter(pair for row in rows for pair in pairwise(row))
    assert len(follows) == count * (count - 1) and len(set(follows.values())) <= 1


def test_blocks_contain_one_condition_each() -> None:
    for order, wanted in (("latin-square", make_williams_row(3, 1)), ("given", [0, 1, 2])):
        trials = plan_trials(make_file(design={"seed": 5, "order": order}), 2)
        assert [trial.condition for trial in trials] == [at for at in wanted for _ in range(12)]


def test_practice_comes_first() -> None:
    trials = plan_trials(make_file(design={"seed": 5, "practice": 3}), 1)
    assert [trial.practice for trial in trials] == [True] * 3 + [False] * 36
    assert [trial.number for trial in trials] == list(range(1, 40))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"task.reference": None}, "required for compare"),
        ({"procedure.kind": "stair"}, "did you mean 'staircase'"),
        ({"procedure.levels": []}, "constant needs levels"),
        ({"procedure.levels": 0.1}, "must be a list of 0 to 200 numbers above 0 and at most 1e"),
        ({"task.scale_ends": "soft"}, "must be a list of texts of 1 to 64 characters"),
        ({"procedure.kind": "staircase", "procedure.start": 2.0}, "must be from smallest = 0.005"),
        ({"task.parameter": "object.table.material.stifness"}, "is not a key here"),
        ({"task.parameter": "object.chair.material.stiffness_n_per_m"}, "there is no object.chair"),
        ({"task.parameter": "mass.box"}, "the scene has no .world"),
        ({"task.parameter": "guard.force_max_n"}, "of the rig there are rig.guard"),
        ({"task.parameter": "rig.guard.arm"}, "cannot change in a running daemon"),
        ({"factor.0.parameter": "rig.guard.force_max_n", "factor.0.levels": [1.0, -1.0]}, "guard.force_max_n = -1.0"),
        (
            {"rig": "touch", "factor.0.parameter": "rig.guard.continuous_force_n", "factor.0.levels": [0.5, 0.95]},
            "0.95: the rig's 0.88 is the limit of its motors",
        ),
        (
            {"rig": "touch", "overrides": {"rig.guard.heat_time_s": 1e3}},
            "heat_time_s = 1000.0: the rig's .* is the limit of its motors",
        ),
        (  # levels 40.5 / 1.1 to 40.5 / 1.4: none is above 40
            {"task.parameter": "rig.guard.force_max_n", "task.reference": 40.5, "task.more": "down"},
            "guard.force_max_n = 40.5",
        ),
        ({"task.kind": "rate", "task.reference": None, "task.scale": [7, 1]}, "the first mark, from 1"),
        ({"task.scale": [1, 7]}, "only rate has a scale"),
        ({"task.scale_ends": ["soft", "hard"]}, "requires scale"),
        ({"factor.0.scenes": {"a": "sphere"}}, "set one of parameter, scenes and values"),
        ({"procedure.levels": [0.1, 0.2, 0.1]}, "has a level twice"),
        ({"observer.by": {"3.0": {"threshold": 0.1}}}, "no condition is called '3.0'.*; there are 0.0; 1.0; 2.0"),
        ({"observer.by": {"2.0": {"treshold": 0.1}}}, "did you mean 'threshold'"),
        ({"motion": {"thumb": [[0.0, 0.0, 0.0, 0.0]]}}, "motion.thumb: no scene has this finger; there are fingertip"),
        ({"motion": {"fingertip": [[3.0, 0.0, 0.0, 0.0]]}}, "ends at 3 s: set trial.touch_s to that"),
    ],
)
def test_an_unusable_design_is_refused_before_the_session(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        Experiment(make_tables(), changes)


def test_progress_shows_the_block_but_no_condition() -> None:
    blocked = make_file(design={"seed": 5, "order": "given", "practice": 1})
    assert number_blocks(plan_trials(blocked, 1), is_mixed=False) == [1] * 13 + [2] * 12 + [3] * 12
    assert number_blocks(plan_trials(make_file(), 1), is_mixed=True) == [1] * 36
    assert Progress(3, 37, 1, 3, True, 2, 2).title == "Block 1 of 3, trial 3 of 37, practice"
    assert Progress(3, 37, 1, 1, False, 1, 2).text == "Touch 1 of 2"


def test_a_rating_stays_on_its_scale() -> None:
    task = {"kind": "rate", "parameter": STIFFNESS, "question": "?", "scale": [1, 7], "scale_ends": ["soft", "hard"]}
    observer = {"scale": 5.0, "exponent": 2.0, "noise": 0.5}
    experiment = Experiment(
        make_tables(task=task, observer=observer, procedure={"kind": "constant", "levels": [0.1, 1.0, 3.0]})
    )
    assert {row["answer"] for row in experiment.rehearse()} <= {float(mark) for mark in experiment.file.task.marks}


def test_numbers_are_no_comparison() -> None:
    task = {"kind": "rate", "parameter": STIFFNESS, "question": "How stiff?"}
    with pytest.raises(ConfigError, match="must be constant: answers of rate are not right or wrong"):
        Experiment(make_tables(task=task, procedure={"kind": "staircase"}))
