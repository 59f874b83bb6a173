"""What the loop watches of itself and its device: troubles that a tick bears and a run does not.

Each is counted in seconds and paid back by what goes well, so that one of them now and then ends nothing, and one
that stays, or comes back as fast as it goes, ends the run with a name. Two floats a tick, no memory of ticks.

A loop that does not come to its next tick cannot say so: that is for a watchdog in another thread.
"""

from typing import Final, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.server.loop.guard import NOT_FINITE, POSE_JUMPED, POSE_REFUSED

NO_POSE: Final = 5
NO_FORCE: Final = 6
STARVED: Final = 7
JUMPING: Final = 8
"""Faults, numbered on from the ends of the loop (server.loop.shutdown)."""

SILENCE_MAX_S: Final = 0.5
"""Time of ticks without a usable pose, or without a finite force, less that of good ones. The hand feels nothing
meanwhile; half a second bears a cable that was touched, and is not long enough to wonder whether anything runs."""

JUMP_S: Final = 0.1
"""What one jump of a pose counts of that time: each takes the force away for most of the ramp that follows, so five in
a row, or ten a second, leave nothing to render."""

HELD_MAX_S: Final = 0.25
"""Time for which a device may take no wrench, one tick after the other: it keeps the force of before, which no limit of
the guard reaches. As long as a loop that stalls is borne, which does the same."""

LOST_SHARE: Final = 0.5
LOST_MAX_S: Final = 0.5
"""A loop that has lost half a second more than LOST_SHARE of its time does not render: it holds old forces. Gaps of
more than GAP_MIN_S count; reads of 0.24 s, one after the other, end at the fifth."""
GAP_MIN_S: Final = 0.025
"""A shorter gap is no stall: hosts make gaps of 11 to 21 ms, and a device slower than the rate makes one a tick: those
are missed ticks, and it renders all the same, for the guard goes by ticks that happened."""
GAP_MAX_S: Final = 0.25
"""What one gap counts at most. A longer one is the supervisor's, or the whole process slept (a debugger, a suspended
machine), which once is no reason to stop: the guard fades in after it."""


STALL_POLLS: Final = 5
STALL_POLL_S: Final = 0.05
"""A loop has stalled when so many looks in a row, this far apart, find no new tick: a quarter of a second, which
is longer than any host stall seen and shorter than a hand needs to be hurt. Counting looks, not time: a process that
was suspended as a whole did not stall."""
STALL_MAX_S: Final = (STALL_POLLS + 2) * STALL_POLL_S
"""From the last tick to the zero force that a stall ends with, at the most. The look that sees this tick may come a
whole STALL_POLL_S behind it, and STALL_POLLS more follow: 0.30 s. Each of these looks, and the thread that writes the
zero, may wait for its turn of the interpreter, 5 ms each (`sys.getswitchinterval`): 35 ms, for which there is one more
STALL_POLL_S. A device that does not take the zero at once adds its own time."""
STALL_POLLS_WITHOUT_HAND: Final = 100
"""The same where no force is held in a hand, 5 s: a machine that stands still for a while ends no recording."""


class Health(NamedTuple):
    """Seconds: without a force for want of a pose or of a finite number; lost; woken late, of those lost."""

    silent: float
    lost: float
    late: float


HEALTHY: Final = Health(0.0, 0.0, 0.0)


@jit
def examine(health: Health, bits: int, late: float, dt: float, period: float) -> tuple[Health, int]:
    """Health after a tick, and the fault it has come to, 0 for none.

    bits    of the guard in this tick
    late    s  that the thread was woken after the deadline
    dt      s  until the next deadline to be kept, a period when none was missed
    period  s  nominal length of a tick
    """
    bad = bits & (POSE_REFUSED | POSE_JUMPED | NOT_FINITE)
    silent = max(health.silent + (period if bad != 0 else -period), 0.0)
    if bits & POSE_JUMPED:
        silent += JUMP_S
    gap = min(dt - period, GAP_MAX_S)
    if gap < GAP_MIN_S:
        gap = 0.0
    paid = LOST_SHARE * (gap + period)
    lost = max(health.lost + gap - paid, 0.0)
    woken_late = max(health.late + (min(late, gap) - paid if gap > 0.0 else -paid), 0.0)
    fault = 0
    if silent > SILENCE_MAX_S:
        fault = JUMPING if bits & POSE_JUMPED else NO_POSE if bits & POSE_REFUSED else NO_FORCE
    elif lost > LOST_MAX_S:
        fault = STARVED
    return Health(silent, lost, woken_late), fault


class Watchdog:
    """Looks at a loop's progress, every STALL_POLL_S; the slowest loop ticks five times between two looks."""

    def __init__(self) -> None:
        self._seen, self._idle = -1, 0

    def stalled_s(self, ticks: int, due: bool, polls: int = STALL_POLLS) -> float:
        """How long (s) the loop has stalled, 0 while it has not.

        ticks  done so far
        due    whether one is due at all: before the device is armed none is
        polls  looks without a new tick that make a stall
        """
        self._idle = self._idle + 1 if ticks == self._seen and due else 0
        self._seen = ticks
        return self._idle * STALL_POLL_S if self._idle >= polls else 0.0
