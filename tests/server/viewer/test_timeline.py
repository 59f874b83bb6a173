"""Timeline and events of recordings, on synthetic ticks."""

from __future__ import annotations

import numpy as np
import pytest

from softfinger.proxy.record import AT, FREE, RECORD_SIZE, ROLLING, SLIDING
from softfinger.server.viewer.nodes.looks import COLOURS, VisibleState
from softfinger.server.viewer.timeline import (
    COLUMNS,
    Events,
    find_state_runs,
    format_band,
    format_pointer,
)

pytestmark = pytest.mark.plain

RADIUS = 0.01


def rows(modes: list[int], rolled: float = 0.0) -> np.ndarray:
    records = np.zeros((len(modes), RECORD_SIZE))
    records[:, AT.tick] = np.arange(len(modes)) + 40
    records[:, AT.timestamp] = 0.001 * np.arange(len(modes))
    records[:, AT.contact_mode] = modes
    records[:, AT.contact_rolled] = rolled * np.arange(len(modes))
    return records


def test_a_band_has_each_state_where_it_is() -> None:
    records = rows([FREE] * 200 + [ROLLING] * 400)
    records[400:, AT.contact_rolled] = 0.01 * np.arange(200)
    assert find_state_runs(records, RADIUS) == [
        (0, VisibleState.FREE),
        (200, VisibleState.STICKING),
        (403, VisibleState.ROLLING),
    ]


def test_a_slide_shorter_than_a_column_is_visible() -> None:
    modes = [ROLLING] * (20 * COLUMNS)
    modes[5555] = SLIDING
    runs = find_state_runs(rows(modes), RADIUS)
    assert [state for _, state in runs] == [VisibleState.STICKING, VisibleState.SLIDING, VisibleState.STICKING]
    assert runs[1][0] <= 5555 < runs[2][0] <= runs[1][0] + 20


def test_the_band_and_its_pointer_as_html() -> None:
    drawn = format_band({"a<b": rows([FREE] * 10 + [SLIDING] * 30)}, {"a<b": RADIUS})
    free, sliding = (f"rgb{COLOURS[state]}" for state in (VisibleState.FREE, VisibleState.SLIDING))
    assert f'<rect x="0" width="10" height="1" fill="{free}"/><rect x="10" width="30"' in drawn
    assert f'fill="{sliding}"' in drawn and "a&lt;b" in drawn and "a<b" not in drawn
    assert "margin-left: 50.00%" in format_pointer(0.5)


def test_events_can_be_reached_from_both_sides() -> None:
    event_maps = (
        {"tick": 60, "kind": "mark", "name": "mark", "label": "<here>"},
        {"tick": 45, "kind": "contact", "name": "touch", "cause": "touch"},
        {"tick": 9999, "kind": "lifecycle", "name": "stopped"},
    )
    events = Events({"": rows([FREE] * 100)}, event_maps, 1000.0)
    assert [events.after(-1), events.after(5), events.after(20), events.after(99)] == [5, 20, 99, None]
    assert [events.before(5), events.before(20), events.before(99)] == [None, 5, 20]
    assert "no event yet" in events.format_html(4)
    text = events.format_html(20)
    assert text.index("0.020 s · mark mark, label &lt;here&gt;") < text.index("0.005 s · contact touch")
    assert "<here>" not in text


def test_events_follow_from_the_ticks_if_none_are_recorded() -> None:
    records = rows([ROLLING] * 10 + [FREE] * 10)
    records[10, AT.contact_cause] = 6
    events = Events({"": records}, (), 1000.0)
    assert events.after(0) == 10 and "release" in events.format_html(10)
