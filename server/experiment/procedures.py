"""Which level a trial has: constant stimuli, a staircase, QUEST+.

A procedure is told every answer in turn and draws no random number, so that told the same answers it goes on alike:
a session that is resumed tells it those of the journal.
"""

from __future__ import annotations

from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray

from softfinger.server.experiment.psychometric import GUESS, SLOPES, probability
from softfinger.server.experiment.schema import Procedure

GRID: Final = 60
"""Thresholds that QUEST+ weighs, in even steps of the logarithm from half the least level to twice the largest."""
BIG_STEPS: Final = 2
"""Until a staircase has turned so often, its steps are twice as large."""


class Adaptive(Protocol):
    """Chooses levels by the answers."""

    def level(self) -> float:
        """Of the next trial."""

    def answered(self, level: float, right: bool) -> None:
        """Take the answer of a trial."""


def adaptive(procedure: Procedure, lapse: float) -> Adaptive | None:
    """The procedure of one condition; None for constant stimuli, whose levels are in the order.

    lapse  share of wrong answers at the largest levels, which QUEST+ takes as known
    """
    match procedure.kind:
        case "staircase":
            return Staircase(procedure)
        case "questplus":
            return QuestPlus(procedure.levels, lapse)
    return None


class Staircase:
    """`down` right answers in a row lead a step down, a wrong one a step up: a transformed up-down staircase.

    It settles where the probability of `down` right answers in a row is a half, 71 % right for two.

    Source: Levitt, Journal of the Acoustical Society of America 49 (1971) 467-477.
    """

    def __init__(self, procedure: Procedure) -> None:
        self._procedure = procedure
        self._level, self._right, self._way = procedure.start, 0, 0
        self.turns = 0

    def level(self) -> float:
        return self._level

    def answered(self, level: float, right: bool) -> None:
        self._right = self._right + 1 if right else 0
        if right and self._right < self._procedure.down:
            return
        self._right, way = 0, -1 if right else 1
        self.turns += self._way not in (0, way)
        self._way = way
        step = self._procedure.step ** (way * (1 if self.turns >= BIG_STEPS else 2))
        self._level = min(max(level * step, self._procedure.smallest), self._procedure.largest)


class QuestPlus:
    """The level whose answer is expected to say most about threshold and slope of a Weibull function.

    Uncertainty is the entropy of the posterior on a grid, the prior even in the logarithms.

    Source: Watson, Journal of Vision 17 (2017) 3:10, eq. 8 to 13; for two parameters and two outcomes it is the psi
    method of Kontsevich and Tyler, Vision Research 39 (1999) 2729-2737.
    """

    def __init__(self, levels: tuple[float, ...], lapse: float) -> None:
        self._levels = np.array(sorted(levels))
        thresholds = np.geomspace(0.5 * self._levels[0], 2.0 * self._levels[-1], GRID)
        threshold, slope = (grid.ravel() for grid in np.meshgrid(thresholds, SLOPES, indexing="ij"))
        self._right = probability(self._levels[:, None], threshold, slope, GUESS, lapse)
        self._posterior = np.full(len(threshold), 1.0 / len(threshold))

    def level(self) -> float:
        right = self._right @ self._posterior
        after_right = _entropy(self._right * self._posterior / right[:, None])
        after_wrong = _entropy((1.0 - self._right) * self._posterior / (1.0 - right)[:, None])
        return float(self._levels[np.argmin(right * after_right + (1.0 - right) * after_wrong)])

    def answered(self, level: float, right: bool) -> None:
        row = self._right[int(np.argmin(abs(self._levels - level)))]
        self._posterior = self._posterior * (row if right else 1.0 - row)
        self._posterior /= self._posterior.sum()


def _entropy(chances: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of each row, in nats."""
    entropy: NDArray[np.float64] = -(chances * np.log(np.maximum(chances, 1e-300))).sum(axis=-1)
    return entropy
