"""Words of the force switch that the publisher process writes: in a file of their own, since it imports no kernels."""

from __future__ import annotations

from typing import Final

ASKED: Final = 3
"""Count of requests that take the force off, written by the publisher."""
OBEYED: Final = 4
"""Count of those that the daemon has answered."""
