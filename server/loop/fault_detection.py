"""Detection of faults of the loop and its device that one tick tolerates but a run does not.

Bad ticks add to the time of a fault, good ticks reduce it. An occasional fault therefore ends nothing, while one that
persists, or returns as fast as it recovers, ends the run with a named error.

A loop that never reaches its next tick cannot detect that itself: the supervisor does, in another thread, with
`Watchdog`.
"""

from typing import Final, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.server.loop.guard import NOT_FINITE, POSE_JUMPED, POSE_REFUSED

NO_POSE: Final = 5
NO_FORCE: Final = 6
STARVED: Final = 7
JUMPING: Final = 8
"""Faults, numbered after the reasons in server.loop.shutdown."""

NO_FORCE_MAX_S: Final = 0.5
"""Time of ticks without a usable pose or a finite force, minus that of good ticks. The force is zero during that time.
Half a second tolerates a cable that was touched, and names the fault before a user searches for it."""

TIME_PER_JUMP_S: Final = 0.1
"""Time that one jump of a pose adds: each removes the force for most of the ramp that follows, so five in a row, or ten
per second, leave nothing to render."""

LOST_SHARE: Final = 0.5
LOST_MAX_S: Final = 0.5
"""A loop that has lost half a second more than LOST_SHARE of its time does not render: it repeats old forces. Gaps
longer than GAP_MIN_S count; successive reads of 0.24 s end the loop at the fifth."""
GAP_MIN_S: Final = 0.025
"""A shorter gap is not a stall: hosts cause gaps of 11 to 21 ms, and a device slower than the rate causes one per tick.
These are missed ticks, but the loop still renders, because the guard counts ticks."""
GAP_MAX_S: Final = 0.25
"""Largest contribution of one gap. A longer gap is handled by the supervisor, or the process slept (a debugger, a
suspended machine), which is no reason to stop if it happens once: the guard fades in afterwards."""


STALL_POLLS: Final = 5
STALL_POLL_S: Final = 0.05
"""A loop has stalled if this many checks in a row, at this interval, find no new tick: a quarter of a second, longer
than any observed stall of a host and too short to hurt a hand. Checks are counted instead of time, so a suspension of
the process is not a stall."""
STALL_MAX_S: Final = (STALL_POLLS + 2) * STALL_POLL_S
"""Longest time from the last tick to the zero force after a stall. The check that finds this tick may come a full
STALL_POLL_S after it, and STALL_POLLS more follow: 0.30 s. Each of these checks, and the thread that writes the zero,
may wait 5 ms for the interpreter (`sys.getswitchinterval`): 35 ms, covered by one more STALL_POLL_S. A device that does
not accept the zero at once adds its time."""
STALL_POLLS_WITHOUT_HAND: Final = 100
"""Checks if no device holds a force in a hand, 5 s: a machine that pauses for a while does not end a recording."""


class FaultTimes(NamedTuple):
    """Accumulated times of the faults, in seconds.

    without_force  time without a force, because a pose or a finite number was missing
    lost           time lost
    late           part of the lost time in which the thread was woken late
    """

    without_force: float
    lost: float
    late: float


NO_FAULT_TIMES: Final = FaultTimes(0.0, 0.0, 0.0)


@jit
def detect_fault(times: FaultTimes, bits: int, late: float, dt: float, period: float) -> tuple[FaultTimes, int]:
    """Return the times after a tick, and the fault that has reached its limit, 0 for none.

    bits    of the guard in this tick
    late    s  from the deadline until the thread was woken
    dt      s  until the next deadline that can be met; a period if none was missed
    period  s  nominal length of a tick
    """
    bad = bits & (POSE_REFUSED | POSE_JUMPED | NOT_FINITE)
    without_force = max(times.without_force + (period if bad != 0 else -period), 0.0)
    if bits & POSE_JUMPED:
        without_force += TIME_PER_JUMP_S
    gap = min(dt - period, GAP_MAX_S)
    if gap < GAP_MIN_S:
        gap = 0.0
    paid = LOST_SHARE * (gap + period)
    lost_time = max(times.lost + gap - paid, 0.0)
    woken_late = max(times.late + (min(late, gap) - paid if gap > 0.0 else -paid), 0.0)
    fault = 0
    if without_force > NO_FORCE_MAX_S:
        fault = JUMPING if bits & POSE_JUMPED else NO_POSE if bits & POSE_REFUSED else NO_FORCE
    elif lost_time > LOST_MAX_S:
        fault = STARVED
    return FaultTimes(without_force, lost_time, woken_late), fault


class Watchdog:
    """Detector of a stalled loop, called every STALL_POLL_S; the slowest loop has five ticks between two calls."""

    def __init__(self) -> None:
        self._last_ticks, self._idle = -1, 0

    def measure_stall_s(self, ticks: int, due: bool, polls: int = STALL_POLLS) -> float:
        """Return for how long (s) the loop has stalled, 0 if it has not.

        ticks  done so far
        due    whether a tick is due: none is before the device is armed
        polls  checks without a new tick that make a stall
        """
        self._idle = self._idle + 1 if ticks == self._last_ticks and due else 0
        self._last_ticks = ticks
        return self._idle * STALL_POLL_S if self._idle >= polls else 0.0
