"""The study of recovery: its numbers by the observer's truth, its table in the page."""

from __future__ import annotations

from pathlib import Path

import pytest

from softfinger.server.experiment.files import list_shipped
from softfinger.tools.experiment_recovery import BLOCK, recovery, table

pytestmark = pytest.mark.plain


def test_a_power_law_is_recovered() -> None:
    """Over 5 seeds the mean exponent misses by less than a tenth: 4 times its standard error of 2 %."""
    (row,) = recovery("friction-magnitude", range(5))
    assert abs(row.bias) < 0.1 and row.truth == 0.8 and row.trials == 56


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", list_shipped())
def test_intervals_hold_the_truth(name: str) -> None:
    """At least 42 of 50 intervals of 90 % contain the true value, in 94 % of such studies."""
    for row in recovery(name, range(50)):
        assert row.coverage >= 0.84 and abs(row.bias) < 0.2


def test_the_page_has_a_row_for_each() -> None:
    """The table in docs/ has every shipped experiment, with the columns of the present code."""
    page = (Path(__file__).parents[2] / "docs" / "measured" / "experiments.md").read_text()
    block = BLOCK.search(page)
    assert block is not None and table([]).splitlines()[0] in block[0]
    assert all(f"| `{name}` |" in block[0] for name in list_shipped())
