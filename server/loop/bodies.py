"""The bodies of a [world] behind a tick of the servo: their step, in time, and what others read of them."""

from typing import Any

from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.jit.seqlock import Slot
from softfinger.proxy.kernels.model import Bodies
from softfinger.proxy.kernels.query.bodies import NO_FAULT, keep_to_budget, step_bodies, tell_motion
from softfinger.server.loop.clock import now_ns


@by_type
def move_bodies(bodies: Any, tick: int, begun: int, motion: Slot, scratch: Any, timespec: Any) -> None:
    """`step_bodies` behind a tick, `keep_to_budget`, and `tell_motion`: bodies with a fault stand where they were told.

    begun    ns, when the step began
    scratch  of `tell_motion`
    """


@move_bodies.of(None)
def move_nothing(bodies: None, tick: int, begun: int, motion: Slot, scratch: Any, timespec: Any) -> None:
    pass


@move_bodies.of(Bodies)
def move_all_bodies(bodies: Bodies, tick: int, begun: int, motion: Slot, scratch: Any, timespec: Any) -> None:
    if step_bodies(bodies) == NO_FAULT:
        keep_to_budget(bodies, now_ns(timespec) - begun)
        tell_motion(bodies, tick, motion, scratch)
