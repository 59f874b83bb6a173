"""What is told of measured times: percentiles, their medians over blocks, and misses while the loop was measured."""

from __future__ import annotations

import numpy as np
import pytest

from softfinger.tools.bench.loop import evaluate
from softfinger.tools.measure import quantiles

pytestmark = pytest.mark.plain


def test_a_stall_spoils_the_percentiles_of_one_block_only() -> None:
    """Five blocks of 1 to 100, one of them a hundred times as long: it shows over the whole, and in no median."""
    block = np.arange(1.0, 101.0)
    found = quantiles(np.concatenate([block, block, 100.0 * block, block, block, [7.0]]), 100)  # the rest is no block
    assert found["max"] == 10_000.0 and found["p99"] > 100.0
    # Percentiles of 1 to 100 by linear interpolation: 1 + 99 q.
    assert found["blocks"] == pytest.approx({"p50": 50.5, "p99": 99.01, "p999": 99.901, "max": 100.0}, rel=1e-12)


def test_fewer_values_than_a_block_are_one() -> None:
    """Then the median over blocks is the percentile itself."""
    found = quantiles(np.array([3.0, 1.0, 2.0]), 100)
    assert found.pop("blocks") == found == {"p50": 2.0, "p99": 2.98, "p999": 2.998, "max": 3.0}


def test_deadlines_missed_before_a_measurement_do_not_count() -> None:
    """Of two turns, whose counts begin at 7 and at 3 and end at 9 and at 4: three."""
    rows = np.full((6, 4), 1e-5)
    rows[:, 3] = [7.0, 7.0, 9.0, 3.0, 4.0, 4.0]
    result = evaluate({"servo": rows}, 1000.0)["servo"]
    assert (result["ticks"], result["missed"]) == (6, 3)
