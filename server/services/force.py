"""Whether there is force: wanted or not and why, on, on its way to zero, or off."""

from __future__ import annotations

from typing import Final

from softfinger.server.loop.tick import Tuning
from softfinger.server.loop.tuning import fading_out, with_armed
from softfinger.server.states import UNARMED, States

ARM_TICKS: Final = 2
"""The first begun before may have met the force; the second has the guard forget it, so that the next fades in."""


class Force:
    """The force of all fingers, and every reason to keep it off.

    It goes from on through fading to off, and back, as `advance` is called; nothing waits. It changes no servo: a
    caller hands what `applied` returns to the loop.

    unarmed  whether somebody has to arm first
    states   go by the reasons
    """

    def __init__(self, unarmed: bool, states: States) -> None:
        self._states = states
        self._disarmed = {UNARMED} if unarmed else set[str]()
        self._guarded = set[str]()
        """Why the guard gives none by itself."""
        self.share: float | None = float(self.wanted)
        """Of the force, None while it is on its way to zero."""
        self._due = 0
        """Ticks after which `advance` may change it."""
        self.given_at = 0
        """How many ticks may have begun before the force was given last."""

    @property
    def wanted(self) -> bool:
        """Whether there is force, or is to be."""
        return not self._disarmed

    @property
    def state(self) -> str:
        """The daemon's."""
        return self._states.now.value

    def kept_off(self, why: str) -> bool:
        """Whether it is kept off for this reason."""
        return why in self._disarmed

    def keep_off(self, why: str) -> None:
        """Add a reason to keep it off."""
        self._disarmed.add(why)

    def allow(self, *why: str) -> None:
        """Take back reasons of `keep_off`."""
        self._disarmed.difference_update(why)

    def note_guard(self, why: str, there: bool) -> None:
        """Note whether the guard keeps it off by itself for this reason."""
        (self._guarded.add if there else self._guarded.discard)(why)

    def tell(self) -> None:
        """Have the state go by what keeps it off now."""
        self._states.follow(self._disarmed | self._guarded)

    def is_off(self, ticks: int) -> bool:
        """Whether it has been taken off, and after so many ticks all hands feel none."""
        return self.share == 0.0 and ticks >= self._due

    def advance(self, ticks: int, to_zero: int) -> bool:
        """The next step after `ticks`, where `to_zero` more take a force off; returns whether there was one."""
        if ticks < self._due:
            return False
        if self.share is None:
            self.share, self._due = 0.0, ticks + ARM_TICKS
        elif self.share and self._disarmed:
            self.share, self._due = None, ticks + to_zero
        elif not self.share and not self._disarmed:
            self.share, self.given_at = 1.0, ticks + ARM_TICKS
        else:
            return False
        return True

    def begin(self, share: float) -> None:
        """Go on with the share that a new loop has begun with."""
        self.share, self._due = share, 0

    def applied(self, tuning: Tuning) -> Tuning:
        """The tuning with as much force as there is to be now."""
        return fading_out(tuning) if self.share is None else with_armed(tuning, self.share)
