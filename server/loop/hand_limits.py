"""Limits of the guard that depend on history or position, applied by `output.py`, which defines their order.

They are the speed of the handle, the heat of the motors, the energy given to the hand, and the edge of the workspace.
Each costs a few operations per tick and one or two numbers of state. A limit of infinity is off.

Speed. The handle's velocity is smoothed over SPEED_TIME_CONSTANT_S as a vector: positions that scatter cancel, and one
pose that is displaced by d counts as d / (SPEED_TIME_CONSTANT_S + period). The largest jump that passes (`speed_max`,
10 mm in a tick of 1 ms) then counts as 0.91 m/s, below the default limit of 2 m/s, so a single outlier does not trip
the limit. A hand at speed v is detected after -SPEED_TIME_CONSTANT_S ln(1 - limit / v).

Heat. A single thermal body is heated by the square of the force, which is proportional to the square of the motors'
current, and cools in proportion to its temperature: dh/dt = ((F / F_c)^2 - h) / tau, in steps h' = (tau h + dt (F /
F_c)^2) / (tau + dt). The steady state under the continuous force F_c is h = 1. Above h = WARM_SHARE, the square of the
allowed force falls linearly to F_c^2 at h = 1, so h never exceeds 1.

Source: the thermal replica of IEC 60255-149, Measuring relays: thermal electrical relays.

Energy. The work of the force on the hand within a contact, as `passivity.py` observes it. Work done by the hand is
discarded when the contact ends. Energy given to the hand accumulates over several contacts and decays over
ENERGY_TIME_CONSTANT_S, so that rounding never reaches the limit. Between the limit and twice the limit, the force is
scaled down linearly to zero, so at most twice the limit is given. The scale depends on the largest energy given, so
that the force is also reduced during the press of the next bounce on an unstable wall.

A device that displays a force d ticks late generates more energy than is observed here: on a spring, over any path in
one contact, up to 2 d + 1 times as much, because sum dx_k dx_(k-j) <= sum dx_k^2 for each of the d ticks.

Source: Hannaford, Ryu (2002), Time-domain passivity control of haptic interfaces, for the observer.
"""

from math import inf, sqrt
from typing import Final, NamedTuple

from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics import vec3

SPEED_TIME_CONSTANT_S: Final = 0.01
"""Time constant of the handle's smoothed velocity. A free handle of 0.1 kg driven by 12 N gains 1.2 m/s in it."""
SLOW_SHARE: Final = 0.5
"""Fraction of the speed limit below which the handle counts as slow again."""
SLOW_TIME_S: Final = 0.5
"""Time for which the handle must be slow before the force returns automatically."""
WARM_SHARE: Final = 0.8
"""Heat above which less than the largest force is allowed."""
ENERGY_TIME_CONSTANT_S: Final = 1.0
"""Time constant with which given energy decays: a limit of 0.5 J is one of 0.5 W in the long run."""


class Workspace(NamedTuple):
    """Soft wall around the handle: box of half sizes `half`, rounded by `radius`; a radius of infinity disables it.

    It is a sphere if the sizes are 0, and a plain box if the radius is 0.

    center     (3,)  m
    half       (3,)  m
    radius           m
    stiffness        N/m
    force_max        N
    """

    center: Vec3
    half: Vec3
    radius: float
    stiffness: float
    force_max: float


class Limits(NamedTuple):
    """Values of the limits; infinity disables a limit.

    speed       m/s  largest speed of the handle
    slow_s      s    time for which the handle must be slow before the force returns; infinity: not until it is disarmed
    continuous  N    continuous force
    heat_s      s    time constant of the heat
    energy      J    largest energy given to the hand
    workspace        soft wall
    """

    speed: float
    slow_s: float
    continuous: float
    heat_s: float
    energy: float
    workspace: Workspace


NO_WALL: Final = Workspace((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), inf, 0.0, 0.0)
UNLIMITED: Final = Limits(inf, 0.0, inf, 1.0, inf, NO_WALL)


class LimitState(NamedTuple):
    """State of the limits.

    velocity      (3,)  m/s  smoothed velocity of the handle
    wait                s    remaining time for which the handle must be slow; 0 if it has not been too fast
    heat                     1 is the steady state under the continuous force
    work                J    work of the hand in this contact, negative if the hand received energy
    energy_given        J    largest energy given to the hand, with decay
    touching                 1 if the last tick was in contact
    """

    velocity: Vec3
    wait: float
    heat: float
    work: float
    energy_given: float
    touching: float


INITIAL_LIMITS: Final = LimitState((0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.0, 0.0)


@jit
def smooth_velocity(velocity: Vec3, displacement: Vec3, dt: float) -> Vec3:
    """Return the smoothed velocity (3,) m/s after the handle moved by `displacement` (3,) m in `dt` s."""
    if not dt > 0.0:
        return velocity
    share = 1.0 / (SPEED_TIME_CONSTANT_S + dt)
    return vec3.add_scaled(vec3.scale(SPEED_TIME_CONSTANT_S * share, velocity), share, displacement)


@jit
def compute_remaining_wait(limits: Limits, wait: float, speed: float, armed: bool, period: float) -> float:
    """Return the remaining time (s) for which the handle must be slow, given its speed (m/s); at 0, force is allowed.

    wait    s  after the last tick
    period  s  nominal length of a tick
    """
    if wait == 0.0 and speed <= limits.speed:
        return 0.0
    if speed > SLOW_SHARE * limits.speed:
        return max(limits.slow_s, period)
    if limits.slow_s < inf:
        return max(wait - period, 0.0)
    return wait if armed else 0.0


@jit
def update_heat(limits: Limits, heat: float, force: Vec3, dt: float) -> float:
    """Return the heat after `dt` s with a force (3,) N."""
    load = vec3.dot(force, force) / (limits.continuous * limits.continuous)
    return (limits.heat_s * heat + dt * load) / (limits.heat_s + dt)


@jit
def compute_heat_limit(limits: Limits, heat: float, largest: float) -> float:
    """Return the largest force (N) that the heat allows; `largest` while the motors are cool."""
    if heat <= WARM_SHARE or largest <= limits.continuous:
        return largest
    steady = limits.continuous * limits.continuous
    headroom = max(1.0 - heat, 0.0) / (1.0 - WARM_SHARE)
    return sqrt(steady + (largest * largest - steady) * headroom)


@jit
def update_work(work: float, tick_work: float, touched: bool, touches: bool, dt: float) -> float:
    """Return the work (J) of the hand after a tick.

    work       J  before the tick
    tick_work  J  to the hand during the tick, by the force of the last tick
    touched       whether that force was a contact force
    touches       whether there is a contact now
    dt         s  length of the tick
    """
    if touched:
        work -= tick_work
    if work < 0.0:
        return work * ENERGY_TIME_CONSTANT_S / (ENERGY_TIME_CONSTANT_S + dt)
    return work if touches else 0.0


@jit
def decay_energy(energy_given: float, work: float, dt: float) -> float:
    """Return the largest energy (J) given, after `dt` s of decay.

    Work of the hand in the next contact does not reduce it.
    """
    return max(energy_given * ENERGY_TIME_CONSTANT_S / (ENERGY_TIME_CONSTANT_S + dt), -work)


@jit
def compute_energy_scale(limits: Limits, energy_given: float) -> float:
    """Return the fraction of the force allowed by the energy given, 0 to 1."""
    if energy_given <= limits.energy:
        return 1.0
    return max(2.0 - energy_given / limits.energy, 0.0)


@jit
def compute_wall_force(wall: Workspace, handle: Vec3) -> tuple[Vec3, bool]:
    """Return the force (3,) N of the soft wall on a handle at (3,) m, and whether it acts."""
    x, y, z = vec3.sub(handle, wall.center)
    hx, hy, hz = wall.half
    out = (x - min(max(x, -hx), hx), y - min(max(y, -hy), hy), z - min(max(z, -hz), hz))
    distance = vec3.norm(out)
    depth = distance - wall.radius
    if not depth > 0.0:
        return (0.0, 0.0, 0.0), False
    return vec3.scale(-min(wall.stiffness * depth, wall.force_max) / distance, out), True
