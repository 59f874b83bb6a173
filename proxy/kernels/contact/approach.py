"""Contacts at the start of a tick, before friction: moved with their objects, rolled, or just detected.

`continuation` and `prediction` continue the contacts of the last tick, `detection` finds a first one.
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.contact_friction import Prediction
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import first_of, replace
from softfinger.proxy.kernels.model import NO_CONTACT, ActiveSet, FingerState, Vec3

NO_PREDICTION = Prediction(NO_CONTACT, (0.0, 0.0, 0.0), 0.0, False)
"""Prediction without a contact."""


STUCK_TICKS = 8
"""Value of `stuck_ticks` from which the proxy restarts at the probe, see `count_stuck_ticks`."""
MOVING_SHARE = 1.0 / 16.0
"""Increment of `stuck_ticks` in a tick in which the proxy moves. It may never come to rest: it may creep by rounding
errors, or cycle between triangles."""


class Approach(NamedTuple):
    """Constraints of the proxy at the start of a tick, before friction; without contact, the first has no object.

    start             (3,) m  start of the proxy's path in this tick, see `find_first_hit`
    clear_center      (3,) m  position where the proxy is known to be outside of all objects
    center            (3,) m  the proxy, with the roll of the only contact
    active                    constraints at `center`
    predicted                 a Prediction for each contact
    rolled            rad     roll angle since touch
    center_lacks_roll         True if the roll is only in the deflection: `center` has not followed it
    is_single                 True for one contact with a known path over its object: other objects are queried after
                              friction
    is_new                    True if the contact starts in this tick
    budget_exhausted          1 if a roll stopped early for lack of budget
    budget                    remaining for the search
    stuck_ticks               count of consecutive ticks without a rest position before this one, see
                              `count_stuck_ticks`
    """

    start: Vec3
    clear_center: Vec3
    center: Vec3
    active: ActiveSet
    predicted: Any
    rolled: float
    center_lacks_roll: bool
    is_single: bool
    is_new: bool
    budget_exhausted: float
    budget: int
    stuck_ticks: float


@jit
def has_ended(active: ActiveSet) -> bool:
    """Return True if no constraint pushes.

    The probe's position is not a criterion: after passing through a thin body it is outside, with the contact active.
    """
    return not (active[0].depth > 0.0 or active[1].depth > 0.0 or active[2].depth > 0.0)


@jit
def count_stuck_ticks(approach: Approach, center: Vec3) -> float:
    """Return the new count of ticks without a rest position, 1 for each tick without a motion of the proxy.

    center  (3,) m  proxy at the end of this tick
    """
    return approach.stuck_ticks + (1.0 if center == approach.clear_center else MOVING_SHARE)


@jit
def release_contacts(state: FingerState) -> Any:
    """Return the state without contacts and their wind-up; a proxy that touches again in this tick can be stuck."""
    return replace(state, "contacts", first_of(state.contacts, NO_CONTACT, NO_CONTACT), "rolled", 0.0)
