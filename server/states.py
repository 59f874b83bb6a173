"""The states of the daemon, and every way from one to another: the table TRANSITIONS, and nothing besides.

`docs/reference/states.md` and its figure are made from it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Set
from enum import StrEnum
from typing import Final


class State(StrEnum):
    """What the daemon is in: `health.state`, `describe`, events of kind `state`."""

    STARTING = "starting"
    READY = "ready"
    ARMED = "armed"
    FAULTED = "faulted"
    STOPPING = "stopping"


MEANINGS: Final = {
    State.STARTING: "devices and kernels are made ready; there is no tick yet",
    State.READY: "ticks go on, and every device has zero force",
    State.ARMED: "forces are rendered, or fade in",
    State.FAULTED: "a fault has removed the force",
    State.STOPPING: "the run ends with zero force",
}


class Trigger(StrEnum):
    """What leads from one state to another."""

    TICK = "tick"
    ARM = "arm"
    DISARM = "disarm"
    FAULT = "fault"
    CLEAR = "clear"
    END = "end"


CAUSES: Final = {
    Trigger.TICK: "the first tick",
    Trigger.ARM: "nothing keeps the force off: the rig arms by itself, `arm`, or a button where the rig has that",
    Trigger.DISARM: "`disarm`",
    Trigger.FAULT: "a handle too fast, a missed heartbeat, or an error that ends the run",
    Trigger.CLEAR: "the handle is slow again, the next heartbeat, `arm`, or a button",
    Trigger.END: "a signal, `stop`, the last tick, or the error of a run",
}

TRANSITIONS: Final = {
    (State.STARTING, Trigger.TICK): State.READY,
    (State.STARTING, Trigger.FAULT): State.FAULTED,
    (State.STARTING, Trigger.END): State.STOPPING,
    (State.READY, Trigger.ARM): State.ARMED,
    (State.READY, Trigger.FAULT): State.FAULTED,
    (State.READY, Trigger.END): State.STOPPING,
    (State.ARMED, Trigger.DISARM): State.READY,
    (State.ARMED, Trigger.FAULT): State.FAULTED,
    (State.ARMED, Trigger.END): State.STOPPING,
    (State.FAULTED, Trigger.CLEAR): State.READY,
    (State.FAULTED, Trigger.END): State.STOPPING,
}
"""The state after a trigger; what is not here changes nothing."""

UNARMED: Final = "not armed yet"
COMMANDED: Final = "disarmed by command"
SILENT: Final = "no heartbeat"
FAST: Final = "the handle was too fast"
"""Why there is no force."""
FAULTS: Final = frozenset({SILENT, FAST})
"""Those of them that are faults."""


class States:
    """The state of a daemon; from any thread.

    tell  is given the state before, the new one, and its cause, in order
    """

    def __init__(self, tell: Callable[[State, State, str], None] = lambda before, after, cause: None) -> None:
        self._tell = tell
        self._lock = threading.RLock()
        self._now = State.STARTING
        self._failed = False

    @property
    def now(self) -> State:
        """The present state."""
        return self._now

    def fire(self, trigger: Trigger, cause: str) -> bool:
        """Go where TRANSITIONS leads; False where it leads nowhere, and nothing has changed."""
        with self._lock:
            after = TRANSITIONS.get((self._now, trigger))
            if after is None:
                return False
            before, self._now = self._now, after
            self._tell(before, after, cause)
            return True

    def fail(self, cause: str) -> None:
        """An error ends the run: nothing clears it any more."""
        with self._lock:
            self._failed = True
            self.fire(Trigger.FAULT, cause)

    def follow(self, reasons: Set[str]) -> None:
        """Go by why there is no force, none of them where there is."""
        with self._lock:
            if self._now is State.STARTING or self._failed:
                return
            cause = ", ".join(sorted(reasons))
            if reasons & FAULTS:
                self.fire(Trigger.FAULT, cause)
                return
            self.fire(Trigger.CLEAR, cause)
            self.fire(*((Trigger.DISARM, cause) if reasons else (Trigger.ARM, "nothing keeps the force off")))
