"""State of the force: the reasons that inhibit it, and the switch that the loop reads."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

import numpy as np
from numpy.typing import NDArray

from softfinger.server.loop.force_switch import UNREACHABLE_MAX_NS
from softfinger.server.loop.switch_fields import DEADLINE_NS, IS_ACTIVE, IS_REQUESTED, UNREACHABLE_NS
from softfinger.server.states import NOT_ARMED_REASON, StateMachine

SWITCH_TICKS: Final = 2
"""The first tick may have started before the switch was written; the second has read it."""


class Force:
    """Force of all fingers, and all reasons that inhibit it; callable from any thread.

    The loop applies the switch: it turns the force off within MAX_OFF_S, and on along the guard's ramp.

    unarmed  whether a person must arm first
    states   updated with the reasons
    switch   memory of the servo's switch (`loop/force_switch.py`)
    ticks    returns the number of ticks done
    """

    def __init__(
        self, unarmed: bool, states: StateMachine, switch: NDArray[np.int64], ticks: Callable[[], int]
    ) -> None:
        self._states, self._switch, self._ticks = states, switch, ticks
        self._lock = threading.Lock()
        self._reasons = {NOT_ARMED_REASON} if unarmed else set[str]()
        self._guard_reasons = set[str]()
        """Reasons for which the guard itself inhibits the force."""
        self._suspended = False
        self._off_tick = -SWITCH_TICKS
        """Number of ticks done when the force was last switched off."""
        self.switched_on_tick = 0
        """Largest number of ticks that may have started before the force was last switched on."""
        switch[IS_REQUESTED] = int(self.is_requested)

    @property
    def is_requested(self) -> bool:
        """True if the force is on or fades in: no reason inhibits it."""
        return not self._reasons

    @property
    def state(self) -> str:
        return self._states.now.value

    @property
    def is_off(self) -> bool:
        """True if the force is switched off and all hands have zero force."""
        switch = self._switch
        return not switch[IS_REQUESTED] and not switch[IS_ACTIVE] and self._ticks() >= self._off_tick + SWITCH_TICKS

    @property
    def is_reachable(self) -> bool:
        """True if a request to turn the force off is received, or commands are off; otherwise the loop turns it off."""
        return bool(self._switch[UNREACHABLE_NS] <= UNREACHABLE_MAX_NS)

    def is_inhibited_by(self, why: str) -> bool:
        return why in self._reasons

    def inhibit(self, why: str) -> None:
        with self._lock:
            self._reasons.add(why)
            self._write()

    def allow(self, *why: str) -> None:
        with self._lock:
            self._reasons.difference_update(why)
            self._write()

    def set_deadline(self, time_ns: int) -> None:
        """Set the time, ns on CLOCK_MONOTONIC, after which the loop turns the force off unless it is extended."""
        self._switch[DEADLINE_NS] = time_ns

    @contextmanager
    def suspend(self) -> Iterator[None]:
        """Turn the force off while the block runs, without adding a reason."""
        self._set_suspended(True)
        try:
            yield
        finally:
            self._set_suspended(False)

    def _set_suspended(self, suspended: bool) -> None:
        with self._lock:
            self._suspended = suspended
            self._write()

    def _write(self) -> None:
        on, before = self.is_requested and not self._suspended, bool(self._switch[IS_REQUESTED])
        if on and not before:
            self.switched_on_tick = self._ticks() + SWITCH_TICKS
        self._switch[IS_REQUESTED] = int(on)
        if before and not on:
            self._off_tick = self._ticks()

    def note_guard(self, why: str, is_inhibiting: bool) -> None:
        """Set whether the guard itself inhibits the force for this reason."""
        (self._guard_reasons.add if is_inhibiting else self._guard_reasons.discard)(why)

    def update_state(self) -> None:
        self._states.follow(self._reasons | self._guard_reasons)
