"""What the measuring verbs share: percentiles, tables, JSON and plots."""

from __future__ import annotations

import argparse
import io
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import ConfigError

Array = NDArray[np.float64]

FORMATS: Final = (".png", ".svg")
QUANTILES: Final = {"p50": 50.0, "p99": 99.0, "p999": 99.9, "max": 100.0}


def add_output_options(parser: argparse.ArgumentParser) -> None:
    """`--json` and `--plot`, which every measurement has."""
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument(
        "--plot", type=Path, metavar="FILE.png", help="draw the result, as .png or .svg (needs the [plots] extra)"
    )


def quantiles(values: Array, block: int) -> dict[str, Any]:
    """Percentiles of `values` (n,), and under `blocks` the median of each over blocks of `block` values.

    The median over blocks is what to compare: a stall of the machine under us spoils one block only.
    """
    found: dict[str, Any] = {name: float(np.percentile(values, at)) for name, at in QUANTILES.items()}
    whole = len(values) // block * block
    blocks = values[:whole].reshape(-1, block) if whole else values.reshape(1, -1)
    found["blocks"] = {name: float(np.median(np.percentile(blocks, at, axis=1))) for name, at in QUANTILES.items()}
    return found


def show(result: Mapping[str, Any], as_json: bool, lines: Sequence[str]) -> None:
    """Print a result: as JSON for machines, as lines for people."""
    print(json.dumps(result, indent=2) if as_json else "\n".join(lines))


def figure(path: Path, width: float = 8.0, height: float = 4.5) -> Any:
    """A matplotlib figure to be saved as `path`; ConfigError when matplotlib is not installed."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ConfigError(f"--plot {path}: matplotlib is not installed: pip install 'softfinger[plots]'") from error
    return Figure(figsize=(width, height), layout="constrained")


def check_figure(path: Path) -> None:
    """ConfigError where a figure could not be saved as `path`."""
    figure(path)
    if path.suffix not in FORMATS:
        raise ConfigError(f"--plot {path}: a figure is {' or '.join(FORMATS)} by its file name")
    if not path.parent.is_dir():
        raise ConfigError(f"--plot {path}: there is no folder {path.parent}: create it or name another")


def save(drawing: Any, path: Path) -> None:
    """Write a figure in the format its name says.

    An SVG is the same for the same data, to be kept beside text: no date, words as words, coordinates to a hundredth.
    """
    if path.suffix != ".svg":
        drawing.savefig(path)
        return
    from matplotlib import rc_context

    text = io.StringIO()
    with rc_context({"svg.hashsalt": "softfinger", "svg.fonttype": "none"}):
        drawing.savefig(text, format="svg", metadata={"Date": None, "Creator": "softfinger"})
    path.write_text(re.sub(r"(\.\d\d)\d+|^ +| +$", r"\1", text.getvalue(), flags=re.MULTILINE), encoding="utf-8")


def microseconds(seconds: float) -> str:
    return f"{seconds * 1e6:9.2f}"
