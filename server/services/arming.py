"""Arming by the program, a command or a button, as selected in the rig, and disarming after the handle was too fast.

The guard itself keeps the force off while the handle is too fast. If a person must arm, the guard continues to do so
until it is disarmed, which is done here.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.server.loop.guard import DISARMED, TOO_FAST
from softfinger.server.services.records import Sink
from softfinger.server.services.rendering import Rendering
from softfinger.server.states import NOT_ARMED_REASON, TOO_FAST_REASON, StateMachine, Trigger

_BUTTON_BITS_END: Final = 2.0**53
"""Upper bound of the bits of the buttons; a device may report nan."""


class Arming:
    """Arming and disarming, evaluated for every tick; its `sink` is not vital, since the guard does not need it."""

    def __init__(self, rendering: Rendering, states: StateMachine) -> None:
        self._rendering, self._states = rendering, states
        fingers = len(rendering.servo.devices)
        columns = [finger * RECORD_SIZE + at for finger in range(fingers) for at in (AT.servo_guard, AT.buttons)]
        self._columns: Final = [AT.tick, *columns]
        self._pressed = -1
        """Buttons of the previous tick; all bits before the first, so a button held from the start does not arm."""
        self.sink: Final = Sink("arming", self.take)

    def take(self, records: NDArray[np.float64], drops: int) -> None:
        """Evaluate a batch (n, fingers x RECORD_SIZE)."""
        by, fast, pressed = self._rendering.rig.guard.arm, False, False
        for tick, *values in records[:, self._columns].tolist():
            bits = [int(guard) for guard in values[::2]]
            fast = tick >= self._rendering.force.switched_on_tick and any(
                b & TOO_FAST and not b & DISARMED for b in bits
            )
            if fast and by != "automatic":
                self._rendering.disarm(TOO_FAST_REASON)
            # A press before the handle was too fast must not restore the force.
            pressed = self._was_pressed(values[1::2]) or (pressed and not fast)
        if by == "automatic":
            self._rendering.force.note_guard(TOO_FAST_REASON, fast)
        elif by == "button" and pressed:
            self._rendering.arm(NOT_ARMED_REASON, TOO_FAST_REASON)
        self._states.fire(Trigger.TICK, "the first tick")
        self._rendering.force.update_state()

    def _was_pressed(self, buttons: list[float]) -> bool:
        down = 0
        for word in buttons:
            down |= int(word) if 0.0 <= word < _BUTTON_BITS_END else 0
        before, self._pressed = self._pressed, down
        return bool(down & ~before)
