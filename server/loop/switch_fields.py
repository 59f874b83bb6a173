"""Words of the force switch (`force_switch.py`). Separate from it for programs that import no kernels."""

from __future__ import annotations

from typing import Final

IS_REQUESTED: Final = 0
"""1: force is requested."""
DEADLINE_NS: Final = 1
"""Time, ns on CLOCK_MONOTONIC, at which the force turns off unless the time is extended."""
IS_ACTIVE: Final = 2
"""Written by the loop: 1 if a hand was given a force in the last tick, or the switch was on."""
STOPS_RECEIVED: Final = 3
"""Number of requests to turn the force off; written by the publisher."""
STOPS_HANDLED: Final = 4
"""Number of such requests that the daemon has handled."""
UNREACHABLE_NS: Final = 5
"""Time, ns, since the process of commands last read requests: it resets the time, the loop counts. -1: no process."""
SIGNAL: Final = 6
"""Number of the signal that ends the run; written by the kernel of the system (`server/signals.py`). 0: none."""
