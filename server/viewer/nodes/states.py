"""Visible state of a contact: sticking, rolling, spinning or sliding. Telemetry has one mode for the first three."""

from __future__ import annotations

from enum import StrEnum
from typing import Final

from softfinger.config.arrays import Array
from softfinger.proxy.record import AT, FREE, SLIDING
from softfinger.server.viewer.nodes.looks import Colour

MIN_ROLL_SPEED_M_PER_S: Final = 2e-3
"""Minimum visible speed of rolling: one pixel in a tenth of a second."""
MIN_SPIN_RATE_RAD_PER_S: Final = 0.05
STATE_TICKS: Final = 100
"""Ticks over which rolling and spinning are detected."""
MAX_GAP_S: Final = 0.5
"""Maximum time between two compared ticks; farther apart, as in a scrubbed recording, they are unrelated."""


class VisibleState(StrEnum):
    """Motion of a contact between two ticks."""

    FREE = "free"
    STICKING = "sticking"
    ROLLING = "rolling"
    SPINNING = "spinning"
    SLIDING = "sliding"


COLOURS: Final[dict[VisibleState, Colour]] = {
    VisibleState.FREE: (130, 140, 150),
    VisibleState.STICKING: (55, 92, 255),
    VisibleState.ROLLING: (0, 120, 250),
    VisibleState.SPINNING: (145, 80, 235),
    VisibleState.SLIDING: (225, 40, 30),
}
"""Colours with a contrast of at least 3 in the light and in the dark look (WCAG 2.2, 1.4.11)."""


def classify_contact(before: Array, row: Array, radius: float) -> VisibleState:
    """Return the state of the contact in a tick (RECORD_SIZE,), compared with an earlier one; `radius` in m."""
    if row[AT.contact_mode] == FREE:
        return VisibleState.FREE
    if row[AT.contact_mode] == SLIDING:
        return VisibleState.SLIDING
    elapsed_s = float(row[AT.timestamp] - before[AT.timestamp])
    if before[AT.contact_mode] == FREE or not 0.0 < elapsed_s <= MAX_GAP_S:
        return VisibleState.STICKING
    if radius * abs(row[AT.contact_rolled] - before[AT.contact_rolled]) > MIN_ROLL_SPEED_M_PER_S * elapsed_s:
        return VisibleState.ROLLING
    if abs(row[AT.contact_spin] - before[AT.contact_spin]) > MIN_SPIN_RATE_RAD_PER_S * elapsed_s:
        return VisibleState.SPINNING
    return VisibleState.STICKING
