"""Visible state of a contact: sticking, rolling, spinning or sliding. Telemetry has one mode for the first three."""

from __future__ import annotations

from enum import StrEnum
from typing import Final

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.record import AT, FREE, SLIDING
from softfinger.server.viewer.nodes.looks import Colour

Array = NDArray[np.float64]

ROLLS_M_PER_S: Final = 2e-3
"""Minimum visible speed of rolling: one pixel in a tenth of a second."""
SPINS_RAD_PER_S: Final = 0.05
"""Minimum visible rate of spin."""
APART_S: Final = 0.5
"""Maximum time between two compared ticks; farther apart, as in a scrubbed recording, they are unrelated."""


class State(StrEnum):
    """Motion of a contact between two ticks."""

    FREE = "free"
    STICKING = "sticking"
    ROLLING = "rolling"
    SPINNING = "spinning"
    SLIDING = "sliding"


COLOURS: Final[dict[State, Colour]] = {
    State.FREE: (130, 140, 150),
    State.STICKING: (10, 25, 150),
    State.ROLLING: (20, 90, 235),
    State.SPINNING: (120, 60, 235),
    State.SLIDING: (225, 35, 25),
}


def state_of(before: Array, row: Array, radius: float) -> State:
    """Return the state of the contact in a tick (RECORD_SIZE,), compared with an earlier one; `radius` in m."""
    if row[AT.contact_mode] == FREE:
        return State.FREE
    if row[AT.contact_mode] == SLIDING:
        return State.SLIDING
    passed = float(row[AT.timestamp] - before[AT.timestamp])
    if before[AT.contact_mode] == FREE or not 0.0 < passed <= APART_S:
        return State.STICKING
    if radius * abs(row[AT.contact_rolled] - before[AT.contact_rolled]) > ROLLS_M_PER_S * passed:
        return State.ROLLING
    if abs(row[AT.contact_spin] - before[AT.contact_spin]) > SPINS_RAD_PER_S * passed:
        return State.SPINNING
    return State.STICKING
