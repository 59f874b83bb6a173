"""Runs that hand their records on in blocks, put together for a test."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def whole(blocks: Iterable[Array]) -> Array:
    """Records (n, RECORD_SIZE) of the only finger, from blocks (m, 1, RECORD_SIZE)."""
    return np.concatenate(list(blocks))[:, 0]
