"""Creation and saving of figures as .png or .svg. matplotlib is an extra, imported when a figure is drawn."""

from __future__ import annotations

import importlib.util
import io
import re
from argparse import ArgumentTypeError
from pathlib import Path
from typing import Any, Final

from softfinger.config.errors import ConfigError
from softfinger.config.files import write_new_file

FORMATS: Final = (".png", ".svg")


def check_figure_path(path: Path) -> str | None:
    """Return why no figure can be saved as `path`; None if one can."""
    if path.suffix not in FORMATS:
        return f"a figure is {' or '.join(FORMATS)} by its file name"
    if not path.parent.is_dir():
        return f"the folder {path.parent} does not exist: create it, or use another"
    if importlib.util.find_spec("matplotlib") is None:
        return "matplotlib is not installed: pip install 'softfinger[plots]'"
    return None


def plot_file(text: str) -> Path:
    """Type of the option `--plot`: raises ArgumentTypeError before the work starts, not after it."""
    path = Path(text)
    if (reason := check_figure_path(path)) is not None:
        raise ArgumentTypeError(f"{path}: {reason}")
    return path


def make_figure(width: float = 8.0, height: float = 4.5) -> Any:
    """Return an empty figure of this size in inches; raises ConfigError without matplotlib."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise ConfigError(f"figures need matplotlib ({error}): pip install 'softfinger[plots]'") from error
    return Figure(figsize=(width, height), layout="constrained")


def draw_legends_below(drawing: Any, axes: Any, size: str) -> None:
    """Draw the legends of two axes side by side below both, where long texts cover no data."""
    for side, panel in zip(("left", "right"), axes, strict=True):
        drawing.legend(*panel.get_legend_handles_labels(), loc=f"outside lower {side}", frameon=False, fontsize=size)


def save(drawing: Any, path: Path) -> None:
    """Write a figure in the format of its file ending.

    SVG files are made for version control: equal for equal data, without a date, with text as text, and with
    coordinates to a hundredth.
    """
    if path.suffix != ".svg":
        with write_new_file(path) as file:
            drawing.savefig(file, format=path.suffix[1:], dpi=150)
        return
    from matplotlib import rc_context

    text = io.StringIO()
    with rc_context({"svg.hashsalt": "softfinger", "svg.fonttype": "none"}):
        drawing.savefig(text, format="svg", metadata={"Date": None, "Creator": "softfinger"})
    rounded = re.sub(r"(\.\d\d)\d+|^ +| +$", r"\1", text.getvalue(), flags=re.MULTILINE)
    with write_new_file(path) as file:
        file.write(rounded.encode())
