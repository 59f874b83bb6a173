"""Recovery of a simulated observer by the shipped experiments: bias of the estimate and coverage of its interval."""

from __future__ import annotations

import math
from collections import defaultdict

import msgspec
import numpy as np
import pytest

from softfinger.config.sources import EXPERIMENTS, list_names
from softfinger.server.experiment.analysis import PowerLaw, fit_groups
from softfinger.server.experiment.experiment import Experiment
from softfinger.server.experiment.trial_order import choose_by_condition

pytestmark = pytest.mark.plain


def recover(name: str, seeds: int) -> dict[str, tuple[float, float]]:
    """For each condition: mean error over the seeds (of thresholds, of their logarithm), and share of intervals of 95 %
    that contain the observer's value."""
    errors = defaultdict[str, list[tuple[float, bool]]](list)
    experiment = Experiment(name)
    for seed in range(seeds):
        design = msgspec.structs.replace(experiment.file.design, seed=seed)
        experiment.file = msgspec.structs.replace(experiment.file, design=design)  # its scenes are read once
        rows = [row | {"participant": "sub-01"} for row in experiment.rehearse()]
        for group in fit_groups(experiment.file, rows):
            condition = next(candidate for candidate in experiment.conditions if candidate.name == group.condition)
            observer = choose_by_condition(experiment.file.observer, condition)
            if isinstance(group.fit, PowerLaw):
                truth, interval = observer.exponent, group.fit.exponent_95
                error = group.fit.exponent / truth - 1.0
            else:
                truth, interval = observer.threshold, group.fit.threshold_95
                error = math.log(group.fit.threshold / truth)
            errors[group.condition].append((error, interval[0] <= truth <= interval[1]))
    return {name: tuple(np.mean(rows, axis=0)) for name, rows in errors.items()}


def test_a_power_law_is_recovered() -> None:
    """Over 5 seeds the mean exponent misses by less than a tenth: 4 times its standard error of 2 %."""
    ((bias, _),) = recover("friction-magnitude", 5).values()
    assert abs(bias) < 0.1


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", list_names(EXPERIMENTS))
def test_intervals_hold_the_truth(name: str) -> None:
    """Over 50 seeds: intervals of 90 % coverage contain the true value in at least 42 of 50 cases in 94 % of such
    studies."""
    for bias, coverage in recover(name, 50).values():
        assert coverage >= 0.84 and abs(bias) < 0.2
