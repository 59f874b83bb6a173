"""Figure of a run: penetration, force, and rolling and torsion angle of the contact, over its modes."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from softfinger.config.arrays import Array
from softfinger.proxy.record import AT, FREE, MODE_NAMES
from softfinger.server.offline.figures import make_figure, save

POINTS_MAX: Final = 2000
"""Largest number of ticks drawn; evenly selected from a longer run."""
SHADES: Final = {"rolling": "#cfe3f5", "sliding": "#fbe0c3"}


COLUMNS: Final = (
    AT.tick,
    AT.dt,
    AT.contact_penetration,
    *range(AT.force, AT.force + 3),
    AT.contact_rolled,
    AT.contact_spin,
    AT.contact_mode,
)


def draw_run(curves: Array, path: Path) -> None:
    """Draw the COLUMNS (n, 9) of one run's records and save the figure as `path`."""
    tick, dt, penetration, x, y, z, rolled, spin, mode = curves.T
    drawing = make_figure(8.0, 5.5)
    depth, forces, turns = drawing.subplots(3, 1, sharex=True)
    seconds = (tick - tick[0]) * dt[0]
    few = np.unique(np.linspace(0, len(tick) - 1, min(len(tick), POINTS_MAX)).astype(int))

    def draw(axes: Any, values: Array, label: str) -> None:
        axes.plot(seconds[few], values[few], linewidth=1.2, label=label)

    draw(depth, 1e3 * penetration, "penetration")
    depth.set_ylabel("depth [mm]")
    for values, axis in ((x, "x"), (y, "y"), (z, "z")):
        draw(forces, values, f"${axis}$")
    draw(forces, np.linalg.norm(curves[:, 3:6], axis=1), "norm")
    forces.set_ylabel("force on the hand [N]")
    draw(turns, np.rad2deg(rolled), "rolled")
    draw(turns, np.rad2deg(spin), "torsion")
    turns.set(xlabel="time [s]", ylabel="angle [deg]")
    for axes in (depth, forces, turns):
        _shade(axes, seconds, mode, has_legend=axes is depth)
        axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize="small")
        axes.margins(x=0.0)
    save(drawing, path)


def _shade(axes: Any, seconds: Array, modes: Array, has_legend: bool) -> None:
    """Draw a band for each interval in contact; if `has_legend`, each mode is in the legend once."""
    starts = np.flatnonzero(np.diff(modes, prepend=np.nan))
    ends = np.append(starts[1:], len(modes) - 1)
    unlabelled = set(SHADES) if has_legend else set()
    for start, end in zip(starts, ends, strict=True):
        mode = int(modes[start])
        if mode == FREE:
            continue
        name = MODE_NAMES[mode]
        axes.axvspan(
            seconds[start], seconds[end], color=SHADES[name], linewidth=0, label=name if name in unlabelled else None
        )
        unlabelled.discard(name)
