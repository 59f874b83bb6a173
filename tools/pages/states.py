"""States of the daemon and their transitions, as tables and as a figure, all from server/states.py."""

from __future__ import annotations

from typing import Any, Final

from softfinger.server.states import CAUSES, MEANINGS, TRANSITIONS, DaemonState
from softfinger.server.verbs import schema

PLACES: Final = {
    DaemonState.STARTING: (0.0, 1.0),
    DaemonState.READY: (2.4, 1.0),
    DaemonState.ARMED: (5.6, 1.0),
    DaemonState.FAULTED: (3.9, 2.1),
    DaemonState.STOPPING: (5.6, -0.4),
}
"""Position of each state in the figure."""

_ARROW_CURVATURE: Final = 0.14
"""Curvature of an arrow, so that two arrows between the same states are apart."""


def format_tables() -> tuple[str, str]:
    states = schema.format_grid(["state", "meaning"], [[f"`{state}`", meaning] for state, meaning in MEANINGS.items()])
    sources: dict[tuple[Any, DaemonState], list[str]] = {}
    for (before, trigger), after in TRANSITIONS.items():
        sources.setdefault((trigger, after), []).append(f"`{before}`")
    rows = [
        [", ".join(before), f"{trigger}: {CAUSES[trigger]}", f"`{after}`"]
        for (trigger, after), before in sources.items()
    ]
    return states, schema.format_grid(["from", "by", "to"], rows)


def draw(axes: Any) -> None:
    (axes,) = axes
    for (before, trigger), after in TRANSITIONS.items():
        start, end = PLACES[before], PLACES[after]
        axes.annotate(
            "",
            end,
            start,
            arrowprops={
                "arrowstyle": "->",
                "connectionstyle": f"arc3,rad={_ARROW_CURVATURE}",
                "shrinkA": 26,
                "shrinkB": 26,
                "color": "0.4",
            },
        )
        x, y = (0.5 * (a + b) for a, b in zip(start, end, strict=True))
        dx, dy = end[0] - start[0], end[1] - start[1]
        at = (
            x + 0.5 * _ARROW_CURVATURE * dy,
            y - 0.5 * _ARROW_CURVATURE * dx,
        )  # the middle of an arc with this curvature
        axes.annotate(trigger.value, at, ha="center", va="center", fontsize="small", backgroundcolor="white")
    for state, place in PLACES.items():
        box = {"boxstyle": "round,pad=0.5", "facecolor": "white", "edgecolor": "C0"}
        axes.annotate(state.value, place, ha="center", va="center", bbox=box)
    axes.set(xlim=(-0.7, 6.2), ylim=(-0.6, 2.4))
    axes.axis("off")
