"""Step of the bodies of a [world] after each tick of the servo, within its time budget."""

from typing import Any

from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.jit.seqlock import Slot, store
from softfinger.proxy.kernels.model import Bodies
from softfinger.proxy.kernels.query.bodies import NO_FAULT, check_budget, step_bodies, write_motion
from softfinger.server.loop.clock import now_ns


@by_type
def move_bodies(bodies: Any, tick: int, start_ns: int, motion: Slot, scratch: Any, timespec: Any) -> None:
    """Call `step_bodies` and `check_budget`, and publish the motion; on a fault, the last published motion remains.

    start_ns  start of the step
    scratch   array of `write_motion`
    """


@move_bodies.of(None)
def move_nothing(bodies: None, tick: int, start_ns: int, motion: Slot, scratch: Any, timespec: Any) -> None:
    pass


@move_bodies.of(Bodies)
def move_all_bodies(bodies: Bodies, tick: int, start_ns: int, motion: Slot, scratch: Any, timespec: Any) -> None:
    if step_bodies(bodies) == NO_FAULT:
        check_budget(bodies, now_ns(timespec) - start_ns)
        write_motion(bodies, tick, scratch)
        store(motion, scratch)
