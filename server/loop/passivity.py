"""Time-domain passivity: what the rendering has taken from the hand, and damping when it gives more than that.

The force that was commanded is held while the hand moves, so the work of a tick is exactly minus that force
times the motion since. Work below zero is energy that the sampled contact has made; the controller burns
it with a damper for as long as it is owed, also after the release. What was taken during a contact does not
count after it: friction's losses must not pay for the next wall.

Source: Hannaford, Ryu (2002), Time-domain passivity control of haptic interfaces, with the work taken over
the held force as in Ryu, Preusche, Hannaford, Hirzinger (2005), Time domain passivity control with reference
energy following.
"""

from typing import Any, Final, NamedTuple

from softfinger.proxy.kernels.geometry import vec3
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.native.dispatch import by_type
from softfinger.proxy.record import FREE


class Passivity(NamedTuple):
    """Largest damping that may be added, N s/m; 0 observes only."""

    damping_max: float


class Energy(NamedTuple):
    """Work (J) taken from the hand, negative when owed, and the damping (N s/m) that acts because of it."""

    work: float
    damping: float


NO_ENERGY: Final = Energy(0.0, 0.0)


@by_type
def keep_passive(passivity: Any, energy: Energy, held: Vec3, moved: Vec3, mode: float, force: Vec3, dt: float) -> Any:
    """The force with the damping that keeps the rendering passive.

    energy          Energy  what the last tick left
    held    (3,)    N       force that was commanded since, after the guard
    moved   (3,)    m       motion of the hand under it
    mode                    of the contact now
    force   (3,)    N       as the contact step computed it
    dt              s       time since the last tick
    returns         Energy, force (3,) N

    Of forces alone: the moment's work is not counted.
    """


@keep_passive.of(None)
def leave_as_it_is(
    passivity: None, energy: Energy, held: Vec3, moved: Vec3, mode: float, force: Vec3, dt: float
) -> tuple[Energy, Vec3]:
    return energy, force


@keep_passive.of(Passivity)
def burn_what_is_owed(
    passivity: Passivity, energy: Energy, held: Vec3, moved: Vec3, mode: float, force: Vec3, dt: float
) -> tuple[Energy, Vec3]:
    """A damper alpha v burns alpha v^2 T in the tick to come, if the hand goes on as it did: alpha = -E / (v^2 T)."""
    work = energy.work - vec3.dot(held, moved)
    if mode == FREE:
        work = min(work, 0.0)
    if not work < 0.0 or not dt > 0.0 or not passivity.damping_max > 0.0:
        return Energy(work, 0.0), force
    damping, square = passivity.damping_max, vec3.dot(moved, moved)
    if -work * dt < damping * square:
        damping = -work * dt / square
    return Energy(work, damping), vec3.add_scaled(force, -damping / dt, moved)
