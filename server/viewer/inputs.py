"""Keys and gamepads: what else than a mouse leads the hand, a step or a speed at a time."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from math import isfinite, radians
from typing import Any, Final, NamedTuple

from softfinger.server.viewer.scripts import add_script

NUMBERS: Final = 9
"""Of a gamepad: a counter, two sticks, and four buttons."""
REST: Final = 0.15
"""A stick that is let go is seldom at 0."""
SILENT_S: Final = 0.3
"""A gamepad that has told nothing for so long is let go: its page may be gone."""
TOTALS: Final = 7
"""Of two hands: three of each finger, and one of the wheel."""
SESSIONS: Final = 16
"""How many pages have their totals kept; those of the oldest are dropped."""
JUMP_M: Final = 0.02
"""The farthest that a finger is led at once by keys or a wheel."""
SPEED: Final = 0.05
"""m/s of a stick or trigger that is all the way down."""
SPIN_RAD_S: Final = 1.5
STEP_M: Final = 0.001
"""Of a key."""
STEP_RAD: Final = radians(5.0)


class Nudge(NamedTuple):
    """A piece of a way: x, y, z m in the world; roll_x, roll_y m, as a ball on a level plane; spin rad about z; close
    m, of each of several fingers towards their middle."""

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    roll_x: float = 0.0
    roll_y: float = 0.0
    spin: float = 0.0
    close: float = 0.0

    def times(self, factor: float) -> Nudge:
        """So many times as far."""
        return Nudge(*(factor * part for part in self))


KEYS: Final[dict[str, tuple[str, str | None, Nudge]]] = {
    "hand to the left": ("J", None, Nudge(x=-STEP_M)),
    "hand to the right": ("L", None, Nudge(x=STEP_M)),
    "hand away": ("I", None, Nudge(y=STEP_M)),
    "hand nearer": ("K", None, Nudge(y=-STEP_M)),
    "hand up": ("U", None, Nudge(z=STEP_M)),
    "hand down, which presses": ("O", None, Nudge(z=-STEP_M)),
    "roll to the left": ("J", "shift", Nudge(roll_x=-STEP_M)),
    "roll to the right": ("L", "shift", Nudge(roll_x=STEP_M)),
    "roll away": ("I", "shift", Nudge(roll_y=STEP_M)),
    "roll nearer": ("K", "shift", Nudge(roll_y=-STEP_M)),
    "spin to the left": ("N", None, Nudge(spin=STEP_RAD)),
    "spin to the right": ("M", None, Nudge(spin=-STEP_RAD)),
    "fingers together": ("H", None, Nudge(close=STEP_M)),
    "fingers apart": ("G", None, Nudge(close=-STEP_M)),
}
"""What each key does, by the name that the page's list of commands has for it: key, modifier, nudge a stroke.

W, A, S, D, Q, E and the arrows move the camera already."""


def add_keys(gui: Any, nudge: Callable[[Nudge], None]) -> None:
    """The keys of KEYS, wherever on the page; held, they repeat."""
    for name, (key, modifier, step) in KEYS.items():
        gui.add_command(name, hotkey=key, modifier=modifier).on_trigger(lambda event, step=step: nudge(step))


class Gamepad:
    """A gamepad at the computer of whoever looks."""

    def __init__(self, gui: Any) -> None:
        self._field = add_script(gui, "gamepad")
        self._field.on_update(self._told)
        self._speed, self._at = Nudge(), 0.0

    def _told(self, event: Any) -> None:
        if event.client is not None:
            self._speed, self._at = speed_of(self._field.value), time.monotonic()

    def moved(self, dt: float) -> Nudge | None:
        """How far it has led the hand in `dt` s; None while it is let go."""
        if self._speed == Nudge() or time.monotonic() - self._at > SILENT_S:
            return None
        return self._speed.times(dt)


class TwoHands:
    """Keys of two hands and a wheel, each a finger: `hands.js` tells how far they have led since it began."""

    def __init__(self, gui: Any) -> None:
        self._field = add_script(gui, "hands")
        self._field.on_update(self._told)
        self._totals: dict[str, tuple[float, ...]] = {}
        self._moves: deque[tuple[float, ...]] = deque()

    def _told(self, event: Any) -> None:
        found = totals_of(self._field.value)
        if event.client is None or found is None:
            return
        session, totals = found
        before = self._totals.pop(session, (0.0,) * len(totals))
        self._totals[session] = totals
        while len(self._totals) > SESSIONS:  # the oldest
            del self._totals[next(iter(self._totals))]
        self._moves.append(tuple(now - then for now, then in zip(totals, before, strict=True)))

    def moved(self) -> tuple[Nudge, Nudge, float] | None:
        """How far the left finger, the right one, and both towards each other (m) since the last time; None: not."""
        moves = [self._moves.popleft() for _ in range(len(self._moves))]
        if not moves:
            return None
        far = [min(max(sum(part), -JUMP_M), JUMP_M) for part in zip(*moves, strict=True)]
        return Nudge(*far[:3]), Nudge(*far[3:6]), far[6]


def totals_of(told: str) -> tuple[str, tuple[float, ...]] | None:
    """What the script of two hands tells: the page's session; x, y, z of the left finger, of the right one, and how far
    both are closed, m. None where it is not that."""
    words = told.split()
    try:
        totals = tuple(float(word) / 1000.0 for word in words[2:])
    except ValueError:
        return None
    return (words[1], totals) if len(totals) == TOTALS and all(map(isfinite, totals)) else None


def speed_of(told: str) -> Nudge:
    """What a gamepad's numbers ask for, each a second; nothing where they are none.

    told  a counter; left stick right and down, right stick right and down; right and left bumper, right and left
          trigger, between -1 and 1 each
    """
    try:
        values = [float(part) for part in told.split()]
    except ValueError:
        return Nudge()
    if len(values) != NUMBERS or not all(isfinite(value) for value in values):
        return Nudge()
    x, y, roll_x, roll_y, right, left, press, lift = (
        0.0 if abs(value) < REST else min(max(value, -1.0), 1.0) for value in values[1:]
    )
    return Nudge(
        x=SPEED * x,
        y=-SPEED * y,
        z=SPEED * (lift - press),
        roll_x=SPEED * roll_x,
        roll_y=-SPEED * roll_y,
        spin=SPIN_RAD_S * (left - right),
    )
