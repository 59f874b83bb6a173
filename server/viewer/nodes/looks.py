"""How things look on the page: its unit, colours, and what a viewer may choose."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from softfinger.proxy.record import FREE, ROLLING, SLIDING

CM: Final = 100.0
"""Units of the page in a metre: a fingertip is then about 1, what the page's cameras and lights are made for."""

Colour = tuple[int, int, int]

OF_MODE: Final[dict[int, Colour]] = {FREE: (130, 140, 150), ROLLING: (20, 90, 235), SLIDING: (225, 35, 25)}
TORSION: Final[Colour] = (235, 130, 0)
SKIN: Final[Colour] = (250, 250, 250)
MARKS: Final[Colour] = (60, 65, 75)
GHOST: Final[Colour] = (70, 165, 105)
NORMAL: Final[Colour] = (30, 120, 60)
CONE: Final[Colour] = (250, 205, 60)
OBJECTS: Final[tuple[Colour, ...]] = ((196, 204, 218), (214, 203, 188), (190, 212, 200), (208, 196, 214))


@dataclass
class Looks:
    """What a viewer may choose.

    cm_per_newton    length of the arrow of a force
    degrees_per_mnm  arc of a torsional moment, degrees a mN m
    cone, traces, ghost, patches  whether each is shown
    """

    cm_per_newton: float = 3.0
    degrees_per_mnm: float = 60.0
    cone: bool = False
    traces: bool = True
    ghost: bool = True
    patches: bool = True
