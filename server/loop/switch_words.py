"""Indices of the force switch that the publisher process uses; a separate file, as that process imports no kernels."""

from __future__ import annotations

from typing import Final

ASKED: Final = 3
"""Number of requests to turn the force off; written by the publisher."""
OBEYED: Final = 4
"""Number of such requests that the daemon has handled."""
