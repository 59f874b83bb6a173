"""`bench soak` detects growth in synthetic series, and a short real run reports every process and figure."""

from __future__ import annotations

import numpy as np
import pytest

from softfinger.tools.bench.soak import SoakResult, compute_growth, evaluate

HOURS = np.linspace(0.0, 2.0, 7200)


def noisy(slope: float) -> np.ndarray:
    random = np.random.default_rng(3)
    return 100.0 + slope * HOURS + 4.0 * (random.random(len(HOURS)) < 0.2)


def soaked(memory: np.ndarray, lost: int = 0) -> SoakResult:
    rows = np.column_stack([memory, np.full(len(memory), 20.0), np.full(len(memory), 8.0)])
    return SoakResult(3600.0 * HOURS, {"daemon": rows}, 7_200_000, 3, 2, lost)


@pytest.mark.parametrize("slope", [0.0, 0.5, 3.0, 30.0])
def test_growth_is_found_in_noise(slope: float) -> None:
    estimate, at_least = compute_growth(HOURS, noisy(slope))
    assert estimate == pytest.approx(slope, abs=0.1)
    assert at_least <= estimate


def test_more_than_a_megabyte_an_hour_is_a_fault() -> None:
    assert evaluate(soaked(noisy(0.3)))["faults"] == []
    (fault,) = evaluate(soaked(noisy(2.0)))["faults"]
    assert fault.startswith("daemon: resident_mb grows by 2.0")
    assert evaluate(soaked(noisy(0.0), lost=2))["faults"] == ["subscribers did not get 2 ticks"]
    step, away = noisy(0.0), noisy(0.0)
    step[4000:] += 10.0
    away[3000:3050] = np.nan
    assert evaluate(soaked(step))["faults"] == evaluate(soaked(away))["faults"] == []
