"""Common parts of the measuring verbs: percentiles, tables, and JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

QUANTILES: Final = {"p50": 50.0, "p99": 99.0, "p999": 99.9, "max": 100.0}


def quantiles(values: Array, block: int) -> dict[str, Any]:
    """Return percentiles of `values` (n,) and, under `blocks`, the median of each over blocks of `block` values.

    Compare the median over blocks: a stall of the machine spoils only one block.
    """
    quantiles: dict[str, Any] = {name: float(np.percentile(values, at)) for name, at in QUANTILES.items()}
    used = len(values) // block * block
    blocks = values[:used].reshape(-1, block) if used else values.reshape(1, -1)
    quantiles["blocks"] = {name: float(np.median(np.percentile(blocks, at, axis=1))) for name, at in QUANTILES.items()}
    return quantiles


def show(result: Mapping[str, Any], as_json: bool, lines: Sequence[str]) -> None:
    print(json.dumps(result, indent=2) if as_json else "\n".join(lines))


def microseconds(seconds: float) -> str:
    return f"{seconds * 1e6:9.2f}"
