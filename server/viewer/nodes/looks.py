"""Appearance of the page: unit of length, colours, settings of the user, and the visible state of a contact.

A contact sticks, rolls, spins or slides. Telemetry has one mode for the first three.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from math import floor, log10
from typing import Final

from softfinger.config.arrays import Array
from softfinger.proxy.record import AT, FREE, SLIDING

CM: Final = 100.0
"""Units of the page per metre. A fingertip then has a size of about 1, which suits viser's cameras and lights."""

Colour = tuple[int, int, int]

TORSION: Final[Colour] = (215, 115, 0)
SKIN: Final[Colour] = (226, 168, 138)
NAIL: Final[Colour] = (250, 214, 206)
PLUMB: Final[Colour] = (128, 134, 146)
SHADOW: Final[Colour] = (40, 44, 54)
"""PLUMB is visible on white and on black, SHADOW on the squares of a plane."""
GHOST: Final[Colour] = (70, 165, 105)
NORMAL: Final[Colour] = (30, 120, 60)
CONE: Final[Colour] = (250, 205, 60)
MAP: Final[Colour] = (214, 178, 120)
"""Colour of a height map, which usually appears on a grey plane or without one."""
ARROW_MAX_CM: Final = 5.0
"""Maximum length of a force arrow that fits the screen."""
OBJECTS: Final[tuple[Colour, ...]] = ((128, 150, 174), (206, 170, 98), (96, 168, 128), (166, 128, 186))


@dataclass
class Looks:
    """Settings of the user.

    newtons_per_cm                force per length of an arrow
    degrees_per_mnm               arc of a torsional moment, degrees per mN m
    cone, traces, ghost, patches  whether each is drawn
    """

    newtons_per_cm: float = 0.3
    degrees_per_mnm: float = 60.0
    cone: bool = False
    traces: bool = True
    ghost: bool = True
    patches: bool = True

    def arrow(self, largest_n: float) -> float:
        """Return the scale of the arrows, N/cm.

        It is the setting or, if the largest force (N) would not fit the screen, the next round number at which it does.
        """
        least = largest_n / ARROW_MAX_CM
        if self.newtons_per_cm >= least:
            return self.newtons_per_cm
        decade = 10.0 ** floor(log10(least))
        return next(digit * decade for digit in (1.0, 2.0, 5.0, 10.0) if digit * decade >= least)


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
