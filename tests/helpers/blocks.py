"""Join records that a run delivers in blocks."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def whole(blocks: Iterable[Array]) -> Array:
    """Return the records (n, RECORD_SIZE) of the only finger from blocks (m, 1, RECORD_SIZE)."""
    return np.concatenate(list(blocks))[:, 0]
