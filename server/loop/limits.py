"""Limits of the guard that look back or at the place: speed of the handle, heat of the motors, energy given to the
hand, and the edge of the workspace. `output.py` has their order.

Each costs a few operations a tick and remembers one or two numbers; a limit of infinity is none.

Speed. The handle's velocity is smoothed over SPEED_S as a vector: positions that scatter cancel, and one pose that is
displaced by d counts as d / (SPEED_S + period). What a jump may be at most (`speed_max`, 10 mm in a tick of 1 ms) is
then 0.91 m/s, below the default limit of 2 m/s: one odd sample is no fast hand, and a hand at v is found out after
-SPEED_S ln(1 - limit / v).

Heat. One body that is heated by the square of the force, as that of the motors' current, and cools as it is hot:
dh/dt = ((F / F_c)^2 - h) / tau, in steps h' = (tau h + dt (F / F_c)^2) / (tau + dt); h = 1 is what the continuous
force F_c comes to in the end. From h = WARM on, the square of the force allowed falls linearly to F_c^2 at h = 1, so h
never passes 1.
Source: the thermal replica of IEC 60255-149, Measuring relays: thermal electrical relays.

Energy. The work of the force on the hand within a contact, as `passivity.py` observes it. What the hand has put in is
lost with the contact; what it was given counts on over several contacts, and is forgotten over FORGET_S, so that
rounding never comes to the limit. Between the limit and twice of it the share of the force falls linearly to zero:
no more than twice the limit is given. The share goes by the most that was given, so that the press of the next bounce
on an unstable wall meets the weaker force too.
A device that displays a force d ticks late makes more than is observed here: on a spring, and any path in one contact,
up to 2 d + 1 times as much, which sum dx_k dx_(k-j) <= sum dx_k^2 says for each of the d ticks.
Source: Hannaford, Ryu (2002), Time-domain passivity control of haptic interfaces, for the observer.
"""

from math import inf, sqrt
from typing import Final, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3

SPEED_S: Final = 0.01
"""Time over which the handle's velocity is smoothed. A handle that 12 N drive without a hand, 0.1 kg, gains 1.2 m/s in
it."""
SLOW: Final = 0.5
"""Share of the speed limit below which the handle is slow again."""
SLOW_S: Final = 0.5
"""How long it has to be, before the force comes back by itself."""
WARM: Final = 0.8
"""Heat from which less than the largest force is allowed."""
FORGET_S: Final = 1.0
"""Time over which energy that was given is forgotten: a limit of 0.5 J is one of 0.5 W in the long run."""


class Workspace(NamedTuple):
    """A soft wall around the handle: (3,) m, (3,) m, m, N/m, N. What it encloses is a box of half sizes `half`, rounded
    by `radius`: a sphere where the sizes are 0, a plain box where the radius is 0. A radius of infinity is no wall."""

    center: Vec3
    half: Vec3
    radius: float
    stiffness: float
    force_max: float


class Limits(NamedTuple):
    """Largest speed of the handle, m/s, and for how long it has to be slow before the force comes back, s: infinity
    means not before it was disarmed; continuous force, N, and its time constant, s; energy, J; the workspace."""

    speed: float
    slow_s: float
    continuous: float
    heat_s: float
    energy: float
    workspace: Workspace


NO_WALL: Final = Workspace((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), inf, 0.0, 0.0)
UNLIMITED: Final = Limits(inf, 0.0, inf, 1.0, inf, NO_WALL)


class Limited(NamedTuple):
    """What the limits remember: smoothed velocity of the handle (3,) m/s; for how long, s, it has to be slow until the
    force comes back, 0 where it has not been too fast; heat, 1 is that of the continuous force; work (J) of the hand
    in this contact, below 0 what it was given; the most that it was given, as far as it is not forgotten; 1 if the last
    tick was in contact."""

    velocity: Vec3
    wait: float
    heat: float
    work: float
    given: float
    touching: float


COLD: Final = Limited((0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.0, 0.0)


@jit
def smoothed(velocity: Vec3, moved: Vec3, dt: float) -> Vec3:
    """The velocity (3,) m/s after the handle has moved by `moved` (3,) m in `dt` s."""
    if not dt > 0.0:
        return velocity
    share = 1.0 / (SPEED_S + dt)
    return vec3.add_scaled(vec3.scale(SPEED_S * share, velocity), share, moved)


@jit
def waiting(limits: Limits, wait: float, speed: float, armed: bool, period: float) -> float:
    """How long (s) the handle still has to be slow at a speed (m/s); 0: there may be force.

    wait    s  after the last tick
    period  s  nominal length of a tick
    """
    if wait == 0.0 and speed <= limits.speed:
        return 0.0
    if speed > SLOW * limits.speed:
        return max(limits.slow_s, period)
    if limits.slow_s < inf:
        return max(wait - period, 0.0)
    return wait if armed else 0.0


@jit
def warmed(limits: Limits, heat: float, force: Vec3, dt: float) -> float:
    """The heat after `dt` s with a force (3,) N."""
    load = vec3.dot(force, force) / (limits.continuous * limits.continuous)
    return (limits.heat_s * heat + dt * load) / (limits.heat_s + dt)


@jit
def coolest(limits: Limits, heat: float, largest: float) -> float:
    """The largest force (N) that the heat allows; `largest` while the motors are cool."""
    if heat <= WARM or largest <= limits.continuous:
        return largest
    steady = limits.continuous * limits.continuous
    left = max(1.0 - heat, 0.0) / (1.0 - WARM)
    return sqrt(steady + (largest * largest - steady) * left)


@jit
def owed(work: float, given: float, touched: bool, touches: bool, dt: float) -> float:
    """Work (J) of the hand after a tick.

    work     J  before it
    given    J  to the hand since, by the force of the last tick
    touched     whether that force was one of a contact
    touches     whether there is a contact now
    dt       s  since then
    """
    if touched:
        work -= given
    if work < 0.0:
        return work * FORGET_S / (FORGET_S + dt)
    return work if touches else 0.0


@jit
def remembered(given: float, work: float, dt: float) -> float:
    """The most energy (J) that was given, after `dt` s: what the hand does in the next contact does not pay for it."""
    return max(given * FORGET_S / (FORGET_S + dt), -work)


@jit
def share_of(limits: Limits, given: float) -> float:
    """The share of the force that the energy given allows, 0 to 1."""
    if given <= limits.energy:
        return 1.0
    return max(2.0 - given / limits.energy, 0.0)


@jit
def wall_force(wall: Workspace, handle: Vec3) -> tuple[Vec3, bool]:
    """Force (3,) N of the soft wall on a handle at (3,) m, and whether there is one."""
    x, y, z = vec3.sub(handle, wall.center)
    hx, hy, hz = wall.half
    out = (x - min(max(x, -hx), hx), y - min(max(y, -hy), hy), z - min(max(z, -hz), hz))
    distance = vec3.norm(out)
    depth = distance - wall.radius
    if not depth > 0.0:
        return (0.0, 0.0, 0.0), False
    return vec3.scale(-min(wall.stiffness * depth, wall.force_max) / distance, out), True
