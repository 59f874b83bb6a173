"""Whether there is force: the reasons to keep it off, and the switch that the loop reads."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

import numpy as np
from numpy.typing import NDArray

from softfinger.server.loop.force_switch import FOREVER, GIVEN, UNTIL, WANTED
from softfinger.server.states import UNARMED, States

SWITCH_TICKS: Final = 2
"""The first tick may have begun before the switch was written; the second has read it."""


class Force:
    """The force of all fingers, and every reason to keep it off; from any thread.

    The loop does the rest: it takes the force off within OFF_S, and gives it back along the guard's ramp.

    unarmed  whether somebody has to arm first
    states   go by the reasons
    switch   words of the servo (`loop/force_switch.py`)
    ticks    returns how many ticks were done
    """

    def __init__(self, unarmed: bool, states: States, switch: NDArray[np.int64], ticks: Callable[[], int]) -> None:
        self._states, self._switch, self._ticks = states, switch, ticks
        self._lock = threading.Lock()
        self._disarmed = {UNARMED} if unarmed else set[str]()
        self._guarded = set[str]()
        """Why the guard gives none by itself."""
        self._suspended = False
        self._off_at = -SWITCH_TICKS
        """How many ticks were done when it was switched off last."""
        self.given_at = 0
        """How many ticks may have begun before the force was given last."""
        switch[WANTED] = int(self.wanted)

    @property
    def wanted(self) -> bool:
        """Whether there is force, or is to be."""
        return not self._disarmed

    @property
    def state(self) -> str:
        """The daemon's."""
        return self._states.now.value

    @property
    def is_off(self) -> bool:
        """Whether it has been taken off, and all hands feel none."""
        switch = self._switch
        return not switch[WANTED] and not switch[GIVEN] and self._ticks() >= self._off_at + SWITCH_TICKS

    def kept_off(self, why: str) -> bool:
        """Whether it is kept off for this reason."""
        return why in self._disarmed

    def keep_off(self, why: str) -> None:
        """Add a reason to keep it off."""
        with self._lock:
            self._disarmed.add(why)
            self._write()

    def allow(self, *why: str) -> None:
        """Take back reasons of `keep_off`."""
        with self._lock:
            self._disarmed.difference_update(why)
            self._write()

    def end_at(self, time_ns: int = FOREVER) -> None:
        """Have the loop take the force off after a time, ns on CLOCK_MONOTONIC, unless another one is set before."""
        self._switch[UNTIL] = time_ns

    @contextmanager
    def suspended(self) -> Iterator[None]:
        """Take the force off while the block runs, for no reason of its own."""
        self._suspend(True)
        try:
            yield
        finally:
            self._suspend(False)

    def _suspend(self, suspended: bool) -> None:
        with self._lock:
            self._suspended = suspended
            self._write()

    def _write(self) -> None:
        on, before = self.wanted and not self._suspended, bool(self._switch[WANTED])
        if on and not before:
            self.given_at = self._ticks() + SWITCH_TICKS
        self._switch[WANTED] = int(on)
        if before and not on:
            self._off_at = self._ticks()

    def note_guard(self, why: str, there: bool) -> None:
        """Note whether the guard keeps it off by itself for this reason."""
        (self._guarded.add if there else self._guarded.discard)(why)

    def tell(self) -> None:
        """Have the state go by what keeps it off now."""
        self._states.follow(self._disarmed | self._guarded)
