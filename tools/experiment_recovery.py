"""Recovery of a simulated observer by experiments: bias of the estimate, and coverage of its interval.

    python -m softfinger.tools.experiment_recovery docs/measured/experiments.md

Each shipped experiment is answered by its simulated observer with a known threshold or exponent, over several seeds.
The program replaces the table of the page between its two comments.
"""

from __future__ import annotations

import argparse
import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import msgspec
import numpy as np

from softfinger.server.experiment.analysis import PowerLaw, fit_groups
from softfinger.server.experiment.experiment import Experiment
from softfinger.server.experiment.files import list_shipped
from softfinger.server.experiment.observer import observer_for

BLOCK: Final = re.compile(r"(<!-- recovery -->\n).*?(<!-- end -->)", re.S)
PROCEDURES: Final = ("stiffness-discrimination", "texture-roughness", "weight-of-a-box")
"""A staircase, QUEST+, and constant stimuli."""
OTHER_SLOPES: Final = (1.0, 3.0)
"""Slopes of observers that differ from the slope assumed by the fit."""


class Recovery(NamedTuple):
    """Recovery of a condition of an experiment over seeds.

    what      threshold or exponent
    truth     of the observer
    bias      mean of the estimate over the truth less 1; for thresholds, of their logarithms
    spread    standard deviation of the same
    coverage  share of 95 % intervals that contain the truth
    """

    experiment: str
    condition: str
    what: str
    trials: int
    truth: float
    bias: float
    spread: float
    coverage: float


def recovery(name: str, seeds: Sequence[int], slope: float | None = None) -> Iterator[Recovery]:
    """Run a shipped experiment for each seed and yield a Recovery for each of its conditions.

    slope  of the observer, in place of the slope of the file
    """
    found = dict[str, list[tuple[float, bool, int, str, float]]]()
    experiment = Experiment(name, {} if slope is None else {"observer.slope": slope})
    for seed in seeds:
        design = msgspec.structs.replace(experiment.file.design, seed=seed)
        experiment.file = msgspec.structs.replace(experiment.file, design=design)  # its scenes are read once
        rows = [row | {"participant": "sub-01"} for row in experiment.rehearse()]
        for group in fit_groups(experiment.file, rows):
            condition = next(each for each in experiment.conditions if each.name == group.condition)
            observer = observer_for(experiment.file, condition)
            if isinstance(group.fit, PowerLaw):
                what, truth, estimate, interval = (
                    "exponent",
                    observer.exponent,
                    group.fit.exponent,
                    group.fit.exponent_95,
                )
                error = estimate / truth - 1.0
            else:
                what, truth, estimate, interval = (
                    "threshold",
                    observer.threshold,
                    group.fit.threshold,
                    group.fit.threshold_95,
                )
                error = math.log(estimate / truth)
            is_covered = interval[0] <= truth <= interval[1]
            found.setdefault(group.condition, []).append((error, is_covered, group.trials, what, truth))
    for named, each in found.items():
        errors = np.array([error for error, *_ in each])
        _, _, trials, what, truth = each[0]
        coverage = sum(is_covered for _, is_covered, *_ in each) / len(each)
        said = named if slope is None else f"{named}, slope {slope:g}"
        yield Recovery(name, said, what, trials, truth, float(errors.mean()), float(errors.std()), coverage)


def table(rows: Sequence[Recovery]) -> str:
    """Return the rows as Markdown."""
    lines = ["| experiment | condition | trials | truth | bias | spread | held by |", "|---|---|---|---|---|---|---|"]
    lines += [
        f"| `{row.experiment}` | {row.condition} | {row.trials} | {row.what} {row.truth:g} | {row.bias:+.1%} | "
        f"{row.spread:.1%} | {row.coverage:.0%} |"
        for row in rows
    ]
    return "\n".join(lines) + "\n"


def main() -> None:
    parser = argparse.ArgumentParser(description="How well the shipped experiments recover a simulated observer.")
    parser.add_argument("page", nargs="?", type=Path, help="page with the table to replace (default: print the table)")
    parser.add_argument("--seeds", type=int, default=50, help="how many (default: %(default)s)")
    args = parser.parse_args()
    seeds = range(args.seeds)
    rows = [row for name in list_shipped() for row in recovery(name, seeds)]
    rows += [row for name in PROCEDURES for slope in OTHER_SLOPES for row in recovery(name, seeds, slope)]
    text = table(rows)
    if args.page is None:
        print(text)
        return
    page = args.page.read_text("utf-8")
    args.page.write_text(BLOCK.sub(lambda match: f"{match[1]}\n{text}\n{match[2]}", page), "utf-8")


if __name__ == "__main__":
    main()
