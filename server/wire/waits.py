"""How long a client waits: seconds, as its user says them, in what libzmq counts."""

from __future__ import annotations

import math
from typing import Final

from softfinger.config.errors import ConfigError

LONGEST_MS: Final = (1 << 31) - 1
"""25 days: what a socket's time-out holds."""


def milliseconds(seconds: float | None) -> int:
    """Whole ms, at most LONGEST_MS; -1, without end, for None. ConfigError for what is no time."""
    if seconds is None:
        return -1
    if math.isnan(seconds):
        raise ConfigError("a time-out of nan s: must be a number of seconds, inf, or None")
    return round(min(max(0.0, 1000.0 * seconds), LONGEST_MS))
