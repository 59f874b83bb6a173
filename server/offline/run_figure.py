"""A run as a picture: how deep, how strong and how wound up the contact was, over the modes it was in."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.record import AT, FREE, MODE_NAMES
from softfinger.server.offline.figures import figure, save

Array = NDArray[np.float64]

POINTS_MAX: Final = 2000
"""Ticks drawn; of a longer run evenly chosen ones."""
SHADES: Final = {"rolling": "#cfe3f5", "sliding": "#fbe0c3"}


def draw_run(records: Array, path: Path) -> None:
    """Draw records (n, RECORD_SIZE) of one run and save them as `path`."""
    drawing = figure(8.0, 5.5)
    depth, forces, turns = drawing.subplots(3, 1, sharex=True)
    seconds = (records[:, AT.tick] - records[0, AT.tick]) * _period(records)
    few = np.unique(np.linspace(0, len(records) - 1, min(len(records), POINTS_MAX)).astype(int))

    def draw(axes: Any, values: Array, label: str) -> None:
        axes.plot(seconds[few], values[few], linewidth=1.2, label=label)

    draw(depth, 1e3 * records[:, AT.contact_penetration], "penetration")
    depth.set_ylabel("depth [mm]")
    for i, axis in enumerate("xyz"):
        draw(forces, records[:, AT.force + i], f"${axis}$")
    draw(forces, np.linalg.norm(records[:, AT.force : AT.force + 3], axis=1), "norm")
    forces.set_ylabel("force on the hand [N]")
    draw(turns, np.rad2deg(records[:, AT.contact_rolled]), "rolled")
    draw(turns, np.rad2deg(records[:, AT.contact_spin]), "torsion")
    turns.set_ylabel("angle [deg]")
    turns.set_xlabel("time [s]")
    for axes in (depth, forces, turns):
        _shade(axes, seconds, records[:, AT.contact_mode], named=axes is depth)
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize="small")
        axes.margins(x=0.0)
    save(drawing, path)


def _period(records: Array) -> float:
    return float(records[0, AT.dt])


def _shade(axes: Any, seconds: Array, modes: Array, named: bool) -> None:
    """A band for every stretch of ticks in contact; if `named`, each mode is in the legend once."""
    starts = np.flatnonzero(np.diff(modes, prepend=np.nan))
    ends = np.append(starts[1:], len(modes) - 1)
    left = set(SHADES) if named else set()
    for start, end in zip(starts, ends, strict=True):
        mode = int(modes[start])
        if mode == FREE:
            continue
        name = MODE_NAMES[mode]
        axes.axvspan(
            seconds[start], seconds[end], color=SHADES[name], linewidth=0, label=name if name in left else None
        )
        left.discard(name)
