"""How many random cases a test takes: few in `make test`, many in `make test-all`."""

from __future__ import annotations

from collections.abc import Callable

from hypothesis import settings

Cases = Callable[[int, int], int]
"""The fixture `cases` of conftest.py: cases(few, many) is how many."""

FULL = settings.get_current_profile_name() == "full"
"""Whether pytest was given --hypothesis-profile=full."""


def examples(few: int, many: int = 10_000) -> settings:
    """Settings of a Hypothesis test that takes so many cases; what else conftest.py says of all of them."""
    return settings(max_examples=many if FULL else few)
