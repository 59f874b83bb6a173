"""Step of the bodies of a [world] after each tick of the servo, within its time budget."""

from typing import Any

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.seqlock import Slot, store
from softfinger.proxy.kernels.query.bodies import NO_FAULT, check_budget, step_bodies, write_motion
from softfinger.server.loop.clock import read_clock_ns


@jit
def move_bodies(bodies: Any, tick: int, start_ns: int, motion: Slot, scratch: Any, timespec: Any) -> None:
    """Call `step_bodies` and `check_budget`, and publish the motion; on a fault, the last published motion remains.

    start_ns  start of the step
    scratch   array of `write_motion`
    """
    if bodies is None:
        return
    if step_bodies(bodies) == NO_FAULT:
        check_budget(bodies, read_clock_ns(timespec) - start_ns)
        write_motion(bodies, tick, scratch)
        store(motion, scratch)
