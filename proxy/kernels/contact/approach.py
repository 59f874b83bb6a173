"""Contacts at the beginning of a tick, before friction: carried along by their objects, rolled, or just met."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.contact.contact_friction import Prediction
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.jit.tuples import first_of, replace
from softfinger.proxy.kernels.model import (
    NO_CONTACT,
    ActiveSet,
    FingerState,
    Vec3,
)

NO_PREDICTION = Prediction(NO_CONTACT, (0.0, 0.0, 0.0), 0.0, False)
"""A place for a prediction, with no contact in it."""


class Approach(NamedTuple):
    """What holds the proxy at the beginning of a tick, before friction; the first constraint is of no object if nothing
    does.

    start        (3,) m  where the way of the proxy in this tick begins, see `first_hit`
    outside      (3,) m  where the proxy is known to be outside of all objects
    center       (3,) m  the proxy, with the roll of the only contact
    active               the constraints at `center`
    predicted            a Prediction for each contact
    rolled       rad     roll angle since touch
    strays               the roll is in the deflection only, and `center` has not gone along
    single               one contact, whose way over its object is known: friction comes before the others are asked
    began                the contact begins in this tick
    bounded              1 if a roll was stopped since the budget was used up
    budget               left for the search
    stuck                ticks in a row before this one in which the proxy found no rest
    """

    start: Vec3
    outside: Vec3
    center: Vec3
    active: ActiveSet
    predicted: Any
    rolled: float
    strays: bool
    single: bool
    began: bool
    bounded: float
    budget: int
    stuck: float


@jit
def has_ended(active: ActiveSet) -> bool:
    """Whether nothing pushes: a probe that has popped through a thin body is outside of it and still active."""
    return not (active[0].depth > 0.0 or active[1].depth > 0.0 or active[2].depth > 0.0)


@jit
def separated(state: FingerState) -> Any:
    """The state without what was wound up in the contact that has ended."""
    return replace(state, "contacts", first_of(state.contacts, NO_CONTACT, NO_CONTACT), "rolled", 0.0, "stuck", 0.0)
