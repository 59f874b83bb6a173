"""Indices of the force switch that the publisher process and the signals use; separate, as they import no kernels."""

from __future__ import annotations

from typing import Final

STOPS_RECEIVED: Final = 3
"""Number of requests to turn the force off; written by the publisher."""
STOPS_HANDLED: Final = 4
"""Number of such requests that the daemon has handled."""
UNREACHABLE_NS: Final = 5
"""Time, ns, since the process of commands last read requests: it resets the time, the loop counts. -1: no process."""
SIGNAL: Final = 6
"""Number of the signal that ends the run; written by the kernel of the system (`server/signals.py`). 0: none."""
