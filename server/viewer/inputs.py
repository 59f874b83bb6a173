"""Keys and gamepads: control of the hand by steps or speeds; validation of values from browsers."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from math import isfinite, radians
from typing import Any, Final, NamedTuple

from softfinger.server.viewer.scripts import add_script

GAMEPAD_VALUES: Final = 9
"""Numbers of a gamepad: a counter, two sticks, and four buttons."""
STICK_DEAD_ZONE: Final = 0.15
"""Dead zone of a stick: a released stick is rarely at 0."""
GAMEPAD_TIMEOUT_S: Final = 0.3
"""Silence after which a gamepad counts as released: its page may be closed."""
HAND_TOTALS: Final = 7
"""Totals of two hands: three per finger, and one of the wheel."""
SESSIONS: Final = 16
"""Maximum number of pages with stored totals; the oldest ones are dropped."""
MAX_STEP_M: Final = 0.02
"""Maximum step of a finger by keys or a wheel."""
MAX_SPEED_M_PER_S: Final = 0.05
"""m/s at full deflection of a stick or trigger."""
SPIN_RAD_S: Final = 1.5
STEP_M: Final = 0.001
STEP_RAD: Final = radians(5.0)


class Nudge(NamedTuple):
    """Increment of a pose.

    x, y, z         m    world frame
    roll_x, roll_y  m    path of a ball that rolls on a horizontal plane
    spin            rad  about z
    close           m    of each of several fingers, towards their centre
    """

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    roll_x: float = 0.0
    roll_y: float = 0.0
    spin: float = 0.0
    close: float = 0.0

    def times(self, factor: float) -> Nudge:
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
"""Key, modifier and increment per press, by the name in the page's list of commands.

W, A, S, D, Q, E and the arrow keys move the camera.
"""


def is_on_slider(slider: Any) -> bool:
    """Return whether a browser's value is a number within the slider's limits: any program may send any value."""
    return bool(slider.min <= slider.value <= slider.max)


def is_in_list(choice: Any) -> bool:
    return choice.value in choice.options


def add_keys(gui: Any, nudge: Callable[[Nudge], None]) -> None:
    """Register the KEYS, active everywhere on the page; they repeat while pressed."""
    for name, (key, modifier, step) in KEYS.items():
        gui.add_command(name, hotkey=key, modifier=modifier).on_trigger(lambda event, step=step: nudge(step))


class Gamepad:
    """Gamepad at the computer of the browser."""

    def __init__(self, gui: Any) -> None:
        self._field = add_script(gui, "gamepad")
        self._field.on_update(self._on_report)
        self._speed, self._reported_s = Nudge(), 0.0

    def _on_report(self, event: Any) -> None:
        if event.client is not None:
            self._speed, self._reported_s = parse_gamepad(self._field.value), time.monotonic()

    def increment(self, dt: float) -> Nudge | None:
        """Return the increment of the hand in `dt` s; None while the gamepad is released."""
        if self._speed == Nudge() or time.monotonic() - self._reported_s > GAMEPAD_TIMEOUT_S:
            return None
        return self._speed.times(dt)


class TwoHands:
    """Keys of two hands and a wheel, one hand per finger; `hands.js` reports the total motion since its start."""

    def __init__(self, gui: Any) -> None:
        self._field = add_script(gui, "hands")
        self._field.on_update(self._on_report)
        self._totals: dict[str, tuple[float, ...]] = {}
        self._moves: deque[tuple[float, ...]] = deque()

    def _on_report(self, event: Any) -> None:
        parsed = parse_hands(self._field.value)
        if event.client is None or parsed is None:
            return
        session, totals = parsed
        previous_totals = self._totals.pop(session, (0.0,) * len(totals))
        self._totals[session] = totals
        while len(self._totals) > SESSIONS:  # drop the oldest
            del self._totals[next(iter(self._totals))]
        self._moves.append(tuple(now - previous for now, previous in zip(totals, previous_totals, strict=True)))

    def increment(self) -> tuple[Nudge, Nudge, float] | None:
        """Return the increments since the last call: left finger, right finger, closing (m); None without a change."""
        moves = [self._moves.popleft() for _ in range(len(self._moves))]
        if not moves:
            return None
        steps = [min(max(sum(part), -MAX_STEP_M), MAX_STEP_M) for part in zip(*moves, strict=True)]
        return Nudge(*steps[:3]), Nudge(*steps[3:6]), steps[6]


def parse_hands(report: str) -> tuple[str, tuple[float, ...]] | None:
    """Parse a report of `hands.js`; None if it is invalid.

    Returns the page's session and the totals, m: x, y, z of the left finger, of the right finger, and closing.
    """
    words = report.split()
    try:
        totals = tuple(float(word) / 1000.0 for word in words[2:])
    except ValueError:
        return None
    return (words[1], totals) if len(totals) == HAND_TOTALS and all(map(isfinite, totals)) else None


def parse_gamepad(report: str) -> Nudge:
    """Parse a report of `gamepad.js` to a speed per second; zero if it is invalid.

    report  a counter; left stick right and down, right stick right and down; right and left bumper, right and left
          trigger, each between -1 and 1
    """
    try:
        values = [float(part) for part in report.split()]
    except ValueError:
        return Nudge()
    if len(values) != GAMEPAD_VALUES or not all(isfinite(value) for value in values):
        return Nudge()
    x, y, roll_x, roll_y, right, left, press, lift = (
        0.0 if abs(value) < STICK_DEAD_ZONE else min(max(value, -1.0), 1.0) for value in values[1:]
    )
    return Nudge(
        x=MAX_SPEED_M_PER_S * x,
        y=-MAX_SPEED_M_PER_S * y,
        z=MAX_SPEED_M_PER_S * (lift - press),
        roll_x=MAX_SPEED_M_PER_S * roll_x,
        roll_y=-MAX_SPEED_M_PER_S * roll_y,
        spin=SPIN_RAD_S * (left - right),
    )
