"""Words of the force switch that the publisher process writes. It imports no kernels, so they have a file of their own."""

from __future__ import annotations

from typing import Final

ASKED: Final = 3
"""Count of requests that take the force off, written by the publisher."""
OBEYED: Final = 4
"""Count of those that the daemon has answered."""
