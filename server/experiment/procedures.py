"""Procedures that choose the level of a trial: staircase and QUEST+; constant stimuli need none.

A procedure receives the answers in order and draws no random number, so it is reproducible: a resumed session passes it
the answers of the journal.
"""

from __future__ import annotations

from typing import Final, Protocol

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from softfinger.server.experiment.psychometric import GUESS, SLOPES, compute_probability
from softfinger.server.experiment.schema_trials import Procedure

GRID_POINTS: Final = 60
"""Number of thresholds in the grid of QUEST+, from half the lowest level to twice the highest, in geometric steps."""
BIG_STEP_REVERSALS: Final = 2
"""Number of reversals until which the steps of a staircase are twice as large."""


class Adaptive(Protocol):
    """Procedure that chooses levels from the answers."""

    def level(self) -> float:
        """Return the level of the next trial."""

    def update(self, level: float, right: bool) -> None:
        """Process the answer of a trial."""


def make_procedures(procedure: Procedure, lapse: float) -> dict[int, Adaptive]:
    """Return the procedures of a condition by the number in `PlannedTrial.staircase`.

    Constant stimuli have none, since the design has their levels.

    lapse  fraction of wrong answers at the highest levels, assumed by QUEST+
    """
    match procedure.kind:
        case "staircase" if procedure.starts:
            return {k: Staircase(replace(procedure, start=start)) for k, start in enumerate(procedure.starts, 1)}
        case "staircase":
            return {0: Staircase(procedure)}
        case "questplus":
            return {0: QuestPlus(procedure.levels, lapse)}
    return {}


class Staircase:
    """Transformed up-down staircase: `down` right answers in a row cause a step down, a wrong one a step up.

    It converges to the level at which the probability of `down` right answers in a row is 1/2: 71 % right for two.

    Source: Levitt, Journal of the Acoustical Society of America 49 (1971) 467-477.
    """

    def __init__(self, procedure: Procedure) -> None:
        self._procedure = procedure
        self._level, self._right, self._direction = procedure.start, 0, 0
        self.reversals = 0

    def level(self) -> float:
        return self._level

    def update(self, level: float, right: bool) -> None:
        self._right = self._right + 1 if right else 0
        if right and self._right < self._procedure.down:
            return
        self._right, direction = 0, -1 if right else 1
        self.reversals += self._direction not in (0, direction)
        self._direction = direction
        step = self._procedure.step ** (direction * (1 if self.reversals >= BIG_STEP_REVERSALS else 2))
        self._level = min(max(level * step, self._procedure.smallest), self._procedure.largest)


class QuestPlus:
    """Procedure that selects the level at which the answer is expected to be most informative on a Weibull function.

    Minimises the expected entropy of the posterior of threshold and slope on a grid; the prior is uniform in the
    logarithms.

    Source: Watson, Journal of Vision 17 (2017) 3:10, eq. 8 to 13; for two parameters and two outcomes it is the psi
    method of Kontsevich and Tyler, Vision Research 39 (1999) 2729-2737.
    """

    def __init__(self, levels: tuple[float, ...], lapse: float) -> None:
        self._levels = np.array(sorted(levels))
        thresholds = np.geomspace(0.5 * self._levels[0], 2.0 * self._levels[-1], GRID_POINTS)
        threshold, slope = (grid.ravel() for grid in np.meshgrid(thresholds, SLOPES, indexing="ij"))
        self._right = compute_probability(self._levels[:, None], threshold, slope, GUESS, lapse)
        self._posterior = np.full(len(threshold), 1.0 / len(threshold))

    def level(self) -> float:
        right = self._right @ self._posterior
        after_right = _compute_entropy(self._right * self._posterior / right[:, None])
        after_wrong = _compute_entropy((1.0 - self._right) * self._posterior / (1.0 - right)[:, None])
        return float(self._levels[np.argmin(right * after_right + (1.0 - right) * after_wrong)])

    def update(self, level: float, right: bool) -> None:
        row = self._right[int(np.argmin(abs(self._levels - level)))]
        self._posterior = self._posterior * (row if right else 1.0 - row)
        self._posterior /= self._posterior.sum()


def _compute_entropy(chances: NDArray[np.float64]) -> NDArray[np.float64]:
    entropy: NDArray[np.float64] = -(chances * np.log(np.maximum(chances, 1e-300))).sum(axis=-1)
    return entropy
