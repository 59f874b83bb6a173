"""Plots of the last seconds: depth, force and torsion below the controls; spin and lateness in a tab."""

from __future__ import annotations

from collections import deque
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.record import AT
from softfinger.server.viewer.nodes.looks import COLOURS, VisibleState, classify_contact

POINTS: Final = 250
POINT_PERIOD_S: Final = 0.04
"""Time between two points; POINTS of them are the last 10 s."""
SPAN_S: Final = POINTS * POINT_PERIOD_S
LINES: Final = ("#1f6feb", "#e5484d")
BANDS: Final = tuple(state for state in VisibleState if state != VisibleState.FREE)
BAND_OPACITY: Final = 0.22
HEIGHT: Final = 66
"""Height of a plot, pixels: three fit below the controls of a window of 800."""
PADDING: Final = (7, 24, 7, 0)
"""Space around a plot, pixels, for the figures at the ends of its axis: top, right, bottom, left."""
AXIS_WIDTH: Final = 58
"""Width of the vertical axis, pixels: room for 10,000 us."""
LABEL_SPACE: Final = 12
"""Least distance of two figures of the vertical axis, pixels: each plot has more than one."""
TIME_HEIGHT: Final = 35
"""Height of the time axis, pixels."""


class Plots:
    """Plots of one finger. Lateness is the maximum over the ticks of a point."""

    def __init__(self, gui: Any, tab: Any) -> None:
        self._points: deque[tuple[float, ...]] = deque(maxlen=POINTS)
        self._late, self._changed = 0.0, False
        self._last_row: NDArray[np.float64] | None = None
        panel = gui.add_panel()
        panel.dock_below(gui.main_panel)
        with panel.add_tab(f"Last {SPAN_S:.0f} s"):
            self._plots = [
                _plot(gui, "depth, mm", ("depth",), 1.0, BANDS),
                _plot(gui, "force, N: normal, tangential (red)", ("normal", "tangential"), 1.0, BANDS),
                _plot(gui, "torsion, mN m", ("torsion",), 1.0, BANDS, has_time=True),
            ]
        with tab:
            self._plots += [
                _plot(gui, "spin, degrees; roll (red)", ("spin", "roll"), 1.0, has_time=True),
                _plot(gui, "wake-up lateness, us; step (red)", ("woken late", "step"), 100.0, has_time=True),
            ]
        self._titles = [str(plot.title) for plot in self._plots]

    def name_finger(self, name: str) -> None:
        for plot, title in zip(self._plots, self._titles, strict=True):
            plot.title = f"{name}: {title}" if name else title

    def add(self, rows: NDArray[np.float64], radius: float) -> None:
        """Add ticks (n, RECORD_SIZE) of the finger, whose radius is in m; earlier ticks than the last start again."""
        for row in rows:
            self._late = max(self._late, row[AT.servo_late])
            before = row if self._last_row is None else self._last_row
            elapsed_s = row[AT.timestamp] - before[AT.timestamp]
            if self._points and 0.0 <= elapsed_s < POINT_PERIOD_S:
                continue
            if elapsed_s < 0.0:
                self._points.clear()
            state, self._last_row = classify_contact(before, row, radius), row
            self._points.append((
                row[AT.timestamp],
                1e3 * row[AT.contact_penetration],
                row[AT.contact_normal_force],
                row[AT.contact_tangential_force],
                1e3 * row[AT.contact_torsion],
                np.degrees(row[AT.contact_spin]),
                np.degrees(row[AT.contact_rolled]),
                1e6 * self._late,
                1e6 * row[AT.servo_exec],
                *(float(state == band) for band in BANDS),
            ))  # fmt: skip
            self._late, self._changed = 0.0, True

    def show(self) -> None:
        if not self._changed or len(self._points) < 2:
            return
        self._changed = False
        columns = np.array(self._points).T
        seconds = columns[0] - columns[0, -1]
        depth, normal, tangential, torsion, spin, roll, late, step, *bands = columns[1:]
        contact_lines = ((*bands, depth), (*bands, normal, tangential), (*bands, torsion))
        for plot, lines in zip(self._plots, (*contact_lines, (spin, roll), (late, step)), strict=True):
            plot.data = (seconds, *lines)


def _plot(
    gui: Any,
    title: str,
    names: tuple[str, ...],
    reach: float,
    bands: tuple[VisibleState, ...] = (),
    has_time: bool = False,
) -> Any:
    """Add a plot of lines, over at least 0 to `reach`, and coloured bands of the states, which are 0 or 1."""
    series = (
        {"label": "s"},
        *(
            {
                "label": str(band),
                "scale": "band",
                "fill": f"rgba{(*COLOURS[band], BAND_OPACITY)}",
                "width": 0,
                "points": {"show": False},
            }
            for band in bands
        ),
        *({"label": name, "stroke": colour, "width": 1.5} for name, colour in zip(names, LINES, strict=False)),
    )
    nothing = np.zeros(2)
    span = {end: {"pad": 0.1, "soft": soft, "mode": 1} for end, soft in (("min", 0.0), ("max", reach))}
    scales = {"x": {"time": False}, "y": {"range": span}, "band": {"range": (0.0, 1.0)}}
    return gui.add_uplot(
        (nothing,) * len(series),
        series,
        title=title,
        scales=scales,
        axes=({"show": has_time, "size": TIME_HEIGHT}, {"show": True, "size": AXIS_WIDTH, "space": LABEL_SPACE}),
        legend={"show": False},
        padding=PADDING,
        height=HEIGHT + TIME_HEIGHT * has_time,
    )
