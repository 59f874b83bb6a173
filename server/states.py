"""States of the daemon and all transitions between them, in the table TRANSITIONS.

`docs/reference/states.md` and its figure are generated from this file.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Set
from enum import StrEnum
from typing import Final


class DaemonState(StrEnum):
    """State of the daemon: `health.state`, `describe` and events of kind `state`."""

    STARTING = "starting"
    READY = "ready"
    ARMED = "armed"
    FAULTED = "faulted"
    STOPPING = "stopping"


MEANINGS: Final = {
    DaemonState.STARTING: "devices and kernels are prepared; there is no tick yet",
    DaemonState.READY: "ticks continue, and every device has zero force",
    DaemonState.ARMED: "forces are rendered, or increase to their full value",
    DaemonState.FAULTED: "a fault has removed the force",
    DaemonState.STOPPING: "the run ends with zero force",
}


class Trigger(StrEnum):
    """Cause of a transition."""

    TICK = "tick"
    ARM = "arm"
    DISARM = "disarm"
    FAULT = "fault"
    CLEAR = "clear"
    END = "end"


CAUSES: Final = {
    Trigger.TICK: "the first tick",
    Trigger.ARM: "the force may be switched on: automatically, by `arm`, or by a button, as in the rig",
    Trigger.DISARM: "`disarm`",
    Trigger.FAULT: "a handle too fast, a missed heartbeat, no command can be received, or an error that ends the run",
    Trigger.CLEAR: "the handle is slow again, the next heartbeat, commands are received again, `arm`, or a button",
    Trigger.END: "a signal, `stop`, the last tick, or the error of a run",
}

TRANSITIONS: Final = {
    (DaemonState.STARTING, Trigger.TICK): DaemonState.READY,
    (DaemonState.STARTING, Trigger.FAULT): DaemonState.FAULTED,
    (DaemonState.STARTING, Trigger.END): DaemonState.STOPPING,
    (DaemonState.READY, Trigger.ARM): DaemonState.ARMED,
    (DaemonState.READY, Trigger.FAULT): DaemonState.FAULTED,
    (DaemonState.READY, Trigger.END): DaemonState.STOPPING,
    (DaemonState.ARMED, Trigger.DISARM): DaemonState.READY,
    (DaemonState.ARMED, Trigger.FAULT): DaemonState.FAULTED,
    (DaemonState.ARMED, Trigger.END): DaemonState.STOPPING,
    (DaemonState.FAULTED, Trigger.CLEAR): DaemonState.READY,
    (DaemonState.FAULTED, Trigger.END): DaemonState.STOPPING,
}
"""Next state by state and trigger; all other triggers are ignored."""

NOT_ARMED_REASON: Final = "not armed yet"
COMMANDED_REASON: Final = "disarmed by command"
NO_HEARTBEAT_REASON: Final = "no heartbeat"
TOO_FAST_REASON: Final = "the handle was too fast"
UNREACHABLE_REASON: Final = "no command can be received"
"""Reasons for zero force."""
FAULT_REASONS: Final = frozenset({NO_HEARTBEAT_REASON, TOO_FAST_REASON, UNREACHABLE_REASON})
"""Reasons for zero force that are faults."""


class StateMachine:
    """State machine of a daemon; thread-safe.

    Parameters
    ----------
    report
        Called on each transition, in order, with the previous state, the new state and the cause.
    """

    def __init__(
        self, report: Callable[[DaemonState, DaemonState, str], None] = lambda before, after, cause: None
    ) -> None:
        self._report = report
        self._lock = threading.RLock()
        self.now = DaemonState.STARTING
        self._failed = False

    def fire(self, trigger: Trigger, cause: str) -> bool:
        """Change to the state given by TRANSITIONS; return False if there is none, which changes nothing."""
        with self._lock:
            after = TRANSITIONS.get((self.now, trigger))
            if after is None:
                return False
            before, self.now = self.now, after
            self._report(before, after, cause)
            return True

    def fail(self, cause: str) -> None:
        """Enter FAULTED because an error ends the run; the fault cannot be cleared."""
        with self._lock:
            self._failed = True
            self.fire(Trigger.FAULT, cause)

    def follow(self, reasons: Set[str]) -> None:
        """Update the state from the reasons for zero force; an empty set means that forces are rendered."""
        with self._lock:
            if self.now is DaemonState.STARTING or self._failed:
                return
            cause = ", ".join(sorted(reasons))
            if reasons & FAULT_REASONS:
                self.fire(Trigger.FAULT, cause)
                return
            self.fire(Trigger.CLEAR, cause)
            self.fire(*((Trigger.DISARM, cause) if reasons else (Trigger.ARM, "the force may be switched on")))
