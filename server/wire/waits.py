"""Conversion of a client's timeout from seconds to the milliseconds of libzmq."""

from __future__ import annotations

import math
from typing import Final

from softfinger.config.errors import ConfigError

LONGEST_MS: Final = (1 << 31) - 1
"""25 days: the largest timeout of a socket."""


def to_milliseconds(seconds: float | None) -> int:
    """Return a timeout in ms, at most LONGEST_MS; -1, without limit, for None. Raises ConfigError for nan."""
    if seconds is None:
        return -1
    if math.isnan(seconds):
        raise ConfigError("a time-out of nan s: must be a number of seconds, inf, or None")
    return round(min(max(0.0, 1000.0 * seconds), LONGEST_MS))
