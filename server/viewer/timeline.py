"""Timeline of a recording: coloured bands of the contact states, and the events."""

from __future__ import annotations

import html
from bisect import bisect_left, bisect_right
from typing import Any, Final

import numpy as np

from softfinger.config.arrays import Array
from softfinger.proxy.record import AT, SLIDING
from softfinger.server.loop.guard import GUARD_NAMES
from softfinger.server.viewer.nodes.looks import COLOURS, STATE_TICKS, VisibleState, classify_contact
from softfinger.server.wire.events import RecordEvents

COLUMNS: Final = 600
"""Columns of a band: two per pixel."""
LISTED_EVENTS: Final = 4
"""Number of events listed at once, latest first."""
HEIGHT: Final = 14


def find_state_runs(rows: Array, radius: float) -> list[tuple[int, VisibleState]]:
    """Return the contact's states, each with its first row (n, RECORD_SIZE); a column with any slip is sliding."""
    wide = max(1, len(rows) // COLUMNS)
    runs: list[tuple[int, VisibleState]] = []
    for first in range(0, len(rows), wide):
        column = rows[first : first + wide]
        slides = np.flatnonzero(column[:, AT.contact_mode] == SLIDING)
        at = first + (int(slides[0]) if len(slides) else len(column) - 1)
        state = classify_contact(rows[max(0, at - STATE_TICKS)], rows[at], radius)
        if not runs or runs[-1][1] != state:
            runs.append((first, state))
    return runs


def format_band(fingers: dict[str, Array], radii: dict[str, float]) -> str:
    """Return the HTML of a band per finger, of the length of the recording, with a legend."""
    count = max(len(rows) for rows in fingers.values())
    lines = []
    for name, rows in fingers.items():
        runs = find_state_runs(rows, radii[name])
        ends = [first for first, _ in runs[1:]] + [len(rows)]
        boxes = "".join(
            f'<rect x="{first}" width="{end - first}" height="1" fill="{_format_css(state)}"/>'
            for (first, state), end in zip(runs, ends, strict=True)
        )
        title = f'<div style="opacity: 0.75">{html.escape(name)}</div>' if name else ""
        lines.append(
            f'{title}<svg viewBox="0 0 {count} 1" preserveAspectRatio="none" '
            f'style="display: block; width: 100%; height: {HEIGHT}px">{boxes}</svg>'
        )
    legend = " ".join(f'<span style="color: {_format_css(state)}">&#9632;</span> {state}' for state in VisibleState)
    return f'<div style="padding: 0 0.75em; font-size: 0.75em">{"".join(lines)}{legend}</div>'


def format_pointer(share: float) -> str:
    """Return the HTML of a pointer above a band at the position `share`, 0 to 1."""
    return (
        f'<div style="padding: 0 0.75em"><div style="margin-left: {100.0 * share:.2f}%; width: 0; '
        "border-left: 5px solid transparent; border-right: 5px solid transparent; border-top: 7px solid currentColor; "
        'transform: translateX(-5px)"></div></div>'
    )


def _format_css(state: VisibleState) -> str:
    return f"rgb{COLOURS[state]}"


class Events:
    """Events of a recording in order of time; if it has none, they are derived from its ticks."""

    def __init__(self, fingers: dict[str, Array], recorded: tuple[dict[str, Any], ...], rate_hz: float) -> None:
        ticks = next(iter(fingers.values()))[:, AT.tick]
        events = [*recorded] or [
            event for name, rows in fingers.items() for event in RecordEvents(GUARD_NAMES, name).observe(rows)
        ]
        at = [int(np.searchsorted(ticks, event.get("tick", -1))) for event in events]
        order = sorted(range(len(events)), key=lambda k: at[k])
        self._rows = [min(at[k], len(ticks) - 1) for k in order]
        self._texts = [describe_event(events[k]) for k in order]
        self._rate_hz = rate_hz

    def before(self, row: int) -> int | None:
        """Return the row of the last event before a row."""
        index = bisect_left(self._rows, row)
        return self._rows[index - 1] if index else None

    def after(self, row: int) -> int | None:
        """Return the row of the first event after a row."""
        index = bisect_right(self._rows, row)
        return self._rows[index] if index < len(self._rows) else None

    def format_html(self, row: int) -> str:
        end = bisect_right(self._rows, row)
        lines = [
            f"{self._rows[k] / self._rate_hz:.3f} s · {html.escape(self._texts[k])}"
            for k in range(end - 1, max(end - 1 - LISTED_EVENTS, -1), -1)
        ]
        text = "<br>".join(lines) or ("no event yet" if self._rows else "no events")
        return f'<div style="padding: 0 0.75em; font-size: 0.75em; line-height: 1.5">{text}</div>'


def describe_event(event: dict[str, Any]) -> str:
    text = f"{event.get('kind', '')} {event.get('name', '')}"
    for key in ("cause", "finger", "label", "message", "count"):
        if event.get(key) not in (None, "", 0, event.get("name")):
            text += f", {key} {event[key]}"
    return text
