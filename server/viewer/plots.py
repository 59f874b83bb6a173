"""Plots of force, depth, spin, torsion and lateness over the last seconds."""

from __future__ import annotations

from collections import deque
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.record import AT

POINTS: Final = 250
POINT_PERIOD_S: Final = 0.02
"""Time between two points."""
COLOURS: Final = ("#1f6feb", "#d1242f")


class Plots:
    """Four plots of one finger. Lateness is the maximum over the ticks of a point."""

    def __init__(self, gui: Any) -> None:
        self._points: deque[tuple[float, ...]] = deque(maxlen=POINTS)
        self._late, self._changed = 0.0, False
        self._plots = [
            _plot(gui, "force, N", ("normal", "tangential")),
            _plot(gui, "depth, mm; torsion, mN m", ("depth", "torsion")),
            _plot(gui, "spin, degrees", ("spin", "roll")),
            _plot(gui, "lateness, us", ("woken late", "step")),
        ]

    def add(self, rows: NDArray[np.float64]) -> None:
        """Add ticks (n, RECORD_SIZE) of the finger."""
        for row in rows:
            self._late = max(self._late, row[AT.servo_late])
            if self._points and 0.0 <= row[AT.timestamp] - self._points[-1][0] < POINT_PERIOD_S:
                continue
            self._points.append((
                row[AT.timestamp],
                row[AT.contact_normal_force],
                row[AT.contact_tangential_force],
                1e3 * row[AT.contact_penetration],
                1e3 * row[AT.contact_torsion],
                np.degrees(row[AT.contact_spin]),
                np.degrees(row[AT.contact_rolled]),
                1e6 * self._late,
                1e6 * row[AT.servo_exec],
            ))  # fmt: skip
            self._late, self._changed = 0.0, True

    def clear(self) -> None:
        self._points.clear()

    def show(self) -> None:
        """Draw the new points."""
        if not self._changed or len(self._points) < 2:
            return
        self._changed = False
        columns = np.array(self._points).T
        seconds = columns[0] - columns[0, -1]
        for k, plot in enumerate(self._plots):
            plot.data = (seconds, columns[1 + 2 * k], columns[2 + 2 * k])


def _plot(gui: Any, title: str, names: tuple[str, str]) -> Any:
    series = ({"label": "s"}, *({"label": n, "stroke": c, "width": 1.5} for n, c in zip(names, COLOURS, strict=True)))
    nothing = np.zeros(2)
    scales = {"x": {"time": False}}
    return gui.add_uplot((nothing, nothing, nothing), series, title=title, scales=scales, height=150)
