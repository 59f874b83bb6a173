"""Appearance of the page: unit of length, colours, and settings of the user."""

from __future__ import annotations

from dataclasses import dataclass
from math import floor, log10
from typing import Final

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
