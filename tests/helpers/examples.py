"""Number of random cases of a test: few in `make test`, many in `make test-all`."""

from collections.abc import Callable

from hypothesis import settings

Cases = Callable[[int, int], int]
"""Type of the fixture `cases` of conftest.py: cases(few, many) returns the number."""

FULL = settings.get_current_profile_name() == "full"
"""True if pytest was started with --hypothesis-profile=full."""


def examples(few: int, many: int = 10_000) -> settings:
    """Return the Hypothesis settings for this number of cases; conftest.py has the common settings."""
    return settings(max_examples=many if FULL else few)
