"""How things look on the page: its unit, colours, and what a viewer may choose."""

from __future__ import annotations

from dataclasses import dataclass
from math import floor, log10
from typing import Final

CM: Final = 100.0
"""Units of the page in a metre: a fingertip is then about 1, what the page's cameras and lights are made for."""

Colour = tuple[int, int, int]

TORSION: Final[Colour] = (235, 130, 0)
SKIN: Final[Colour] = (250, 250, 250)
MARKS: Final[Colour] = (60, 65, 75)
PLUMB: Final[Colour] = (128, 134, 146)
SHADOW: Final[Colour] = (88, 94, 106)
"""Both are seen on white and on black."""
GHOST: Final[Colour] = (70, 165, 105)
NORMAL: Final[Colour] = (30, 120, 60)
CONE: Final[Colour] = (250, 205, 60)
MAP: Final[Colour] = (214, 178, 120)
"""Of a height map, which is mostly seen against a grey plane or none."""
ARROW_MAX_CM: Final = 5.0
"""The longest arrow of a force that stays on the screen."""
OBJECTS: Final[tuple[Colour, ...]] = ((196, 204, 218), (214, 203, 188), (190, 212, 200), (208, 196, 214))


@dataclass
class Looks:
    """What a viewer may choose.

    newtons_per_cm   of the arrow of a force
    degrees_per_mnm  arc of a torsional moment, degrees a mN m
    cone, traces, ghost, patches  whether each is shown
    """

    newtons_per_cm: float = 0.3
    degrees_per_mnm: float = 60.0
    cone: bool = False
    traces: bool = True
    ghost: bool = True
    patches: bool = True

    def arrow(self, largest_n: float) -> float:
        """Scale of the arrows, newtons a cm: as it is set or, where the largest force (N) would leave the screen, the
        next round figure that keeps it there."""
        least = largest_n / ARROW_MAX_CM
        if self.newtons_per_cm >= least:
            return self.newtons_per_cm
        decade = 10.0 ** floor(log10(least))
        return next(digit * decade for digit in (1.0, 2.0, 5.0, 10.0) if digit * decade >= least)
