"""Conversion of a client's timeout from seconds to the milliseconds of libzmq."""

from __future__ import annotations

import math
from typing import Final

from softfinger.config.arguments import describe_refusal, to_number
from softfinger.config.errors import ConfigError

LONGEST_MS: Final = (1 << 31) - 1
"""25 days: the largest timeout of a socket."""


def to_milliseconds(seconds: float | None) -> int:
    """Return a timeout in ms, at most LONGEST_MS; -1, without limit, for None. Raises ConfigError for anything else."""
    if seconds is None:
        return -1
    wait_s = to_number(seconds)
    if math.isnan(wait_s):
        raise ConfigError(describe_refusal("timeout_s", seconds, "a number of seconds, inf, or None"))
    return round(min(max(0.0, 1000.0 * wait_s), LONGEST_MS))
