"""Haptic handle with motors and the hand that grips it, integrated exactly from tick to tick.

Three translational axes. On each, in the world frame,

    M x'' + B x' + K (x - p) - c p' + Coulomb friction = a        M = handle + hand, B = b + c
    tau a' + a = u                                                 a: force of the motors, u: their command

with handle mass and damping b, hand mass, stiffness K and damping c, and p the position that the hand intends. The mass
of the hand moves with the handle. u is the force commanded d ticks ago, its norm limited to the maximum of the motors;
it is constant during a tick (zero-order hold), and p is linear from its value at this tick to the value at the next
(first-order hold). Between two ticks the system is then linear with constant inputs, and the matrix exponential
integrates it without error for any tick; Coulomb friction divides a tick into pieces (`axis`). Encoders round the
position to their resolution. Orientation is sensed and not actuated: it follows that of the hand, immediately or
through a first-order lag.

Sources: matrix exponential and its integral as one exponential, Van Loan (1978); hand as mass, spring and damper about
an intended position, Hogan (1985).
"""

from __future__ import annotations

from math import exp, expm1, floor, inf, pi, sin, sqrt
from typing import Any, Final, NamedTuple

import numpy as np

from softfinger.config.arrays import Array
from softfinger.drivers.simulated.axis import Axis, Inputs, move
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import Quaternion, Vec3
from softfinger.proxy.kernels.numerics import rotations, vec3

DELAY_MAX: Final = 16
"""Maximum transport delay, ticks."""
DELAY_LINE_SIZE: Final = 3 * DELAY_MAX
"""Size (float64) of a delay line, which the caller of `advance` stores: delayed forces, initially 0."""
FLUSH_MAX: Final = 1e-30
"""m, m/s, N: smaller positions, velocities and forces are set to 0. Its square is still a normal number."""
SUBSTEP: Final = 0.5
"""Longest piece summed as a Taylor series, in time constants of the fastest mode."""


class Handle(NamedTuple):
    """Properties of a plant without the hand.

    mass, damping, friction  (3,) kg, N s/m, N  along x, y, z; Coulomb friction
    lag                      s                  time constant of the amplifiers, 0 for none
    force_max                N                  maximum norm of the motors' force
    delay                    ticks              from a command to its effect, 0 to DELAY_MAX
    resolution               m                  step of the encoders, 0 for none
    orientation_lag          s                  time constant of the sensed orientation, 0 for none
    """

    mass: Vec3
    damping: Vec3 = (0.0, 0.0, 0.0)
    friction: Vec3 = (0.0, 0.0, 0.0)
    lag: float = 0.0
    force_max: float = inf
    delay: int = 0
    resolution: float = 0.0
    orientation_lag: float = 0.0


class Impedance(NamedTuple):
    """Impedance of the hand, equal along all axes: mass kg that moves with the handle, damping N s/m, stiffness N/m."""

    mass: float = 0.0
    damping: float = 0.0
    stiffness: float = 0.0


NO_HAND: Final = Impedance()
"""Impedance of a handle without a hand."""


class Plant(NamedTuple):
    """Three axes and their common properties.

    axes              one Axis for each of x, y, z
    rate              Hz      ticks per second, 1 / T
    lag_decay         1       exp(-T / tau), decay of a difference over a tick; 0 for motors without lag
    force_max         N       maximum norm of the motors' force, and its square
    force_max_squared N^2
    delay             ticks   0 to DELAY_MAX
    resolution        m       step of the encoders and its inverse; both 0 for none
    per_resolution    1/m
    orientation_gain  1       fraction of the rotation to the hand's orientation per tick; 1 without lag
    """

    axes: tuple[Axis, Axis, Axis]
    rate: float
    lag_decay: float
    force_max: float
    force_max_squared: float
    delay: float
    resolution: float
    per_resolution: float
    orientation_gain: float


class PlantState(NamedTuple):
    """State of a plant between ticks, without the delayed forces (`DELAY_LINE_SIZE`).

    position, velocity  (3,) m, m/s  of the handle
    force               (3,) N       a, of the motors at the end of the last tick
    goal                (3,) m       p, present intention of the hand
    orientation         (4,)         unit quaternion, fingertip to world
    slot                             index in the delay line of the force that acts next
    """

    position: Vec3
    velocity: Vec3
    force: Vec3
    goal: Vec3
    orientation: Quaternion
    slot: float


class Intention(NamedTuple):
    """Intention of the hand: one pose per tick, and a superposed sinusoid.

    length     number of poses; after the last the first follows if `loop` is 1, else the last is repeated
    amplitude  (3,) m
    frequency  turns per tick
    phase      turns
    """

    length: float
    loop: float
    amplitude: Vec3
    frequency: float
    phase: float


def make_plant(period: float, handle: Handle, hand: Impedance = NO_HAND) -> Plant:
    """Return the plant for ticks of `period` s.

    Raises ValueError if a number is out of range; a device checks its options before.
    """
    mass, damping, friction, lag, force_max, delay, resolution, orientation_lag = handle
    if not (period > 0.0 and min(mass) + hand.mass > 0.0 and 0 <= delay <= DELAY_MAX):
        raise ValueError(f"period {period} and mass {mass} must be above 0, delay {delay} within 0 to {DELAY_MAX}")
    if min(*damping, *friction, lag, force_max, resolution, hand.damping, hand.stiffness, orientation_lag) < 0.0:
        raise ValueError("damping, friction, stiffness, lag, force and resolution must not be negative")
    axes = [
        _make_axis(period, m + hand.mass, b + hand.damping, hand.stiffness, hand.damping, lag, f)
        for m, b, f in zip(mass, damping, friction, strict=True)
    ]
    return Plant(
        axes=(axes[0], axes[1], axes[2]),
        rate=1.0 / period,
        lag_decay=exp(-period / lag) if lag else 0.0,
        force_max=float(force_max),
        force_max_squared=float(force_max) * force_max,
        delay=float(delay),
        resolution=float(resolution),
        per_resolution=1.0 / resolution if resolution else 0.0,
        orientation_gain=-expm1(-period / orientation_lag) if orientation_lag else 1.0,
    )


def make_rest_state(position: Vec3, orientation: Quaternion = (1.0, 0.0, 0.0, 0.0)) -> PlantState:
    zero, (x, y, z), (qw, qx, qy, qz) = (0.0, 0.0, 0.0), position, orientation
    position_floats = (float(x), float(y), float(z))  # ints would be another type, and compile again
    return PlantState(position_floats, zero, zero, position_floats, (float(qw), float(qx), float(qy), float(qz)), 0.0)


def _make_axis(
    period: float, mass: float, damping: float, stiffness: float, hand_damping: float, lag: float, friction: float
) -> Axis:
    # Rows and columns: x, v T, a, p, then the inputs u, p', and a force that bypasses the amplifier. Velocity in metres
    # per tick balances the matrix.
    push = period * period / mass
    change = np.zeros((7, 7))
    change[0, 1] = 1.0
    change[1, [0, 3]] = -stiffness * push, stiffness * push
    change[1, 1] = -damping / mass * period
    change[1, 5], change[1, 6] = hand_damping * push, push
    change[3, 5] = period
    if lag:
        change[1, 2] = push
        change[2, 2], change[2, 4] = -period / lag, period / lag
    else:
        change[1, 4] = push
    after = expm(change)
    x, v = after[0], after[1] / period
    hand = max(damping / mass, sqrt(stiffness / mass))
    fastest = max(hand, 1.0 / lag) if lag else hand
    substep = SUBSTEP / fastest if fastest else inf
    substep_without_lag = SUBSTEP / hand if hand else inf
    # x = p needs no force: the coefficient of x - p is minus the column of p, without cancellation
    coefficients = (
        -x[3], x[1] * period, x[2], x[4], x[5], x[6],
        -v[3], v[1] * period, v[2], v[4], v[5], v[6],
        friction, 1.0 / mass, damping / mass, stiffness / mass, hand_damping / mass, 1.0 / lag if lag else 0.0,
        period, substep, substep_without_lag,
    )  # fmt: skip
    return Axis(*map(float, coefficients))


def expm(matrix: Array) -> Array:
    """Return the exponential of a square matrix: Taylor series of the matrix over 2^s, squared s times."""
    size = float(np.linalg.norm(matrix, 1))
    squarings = max(0, int(np.ceil(np.log2(size))) + 1) if size > 0.0 else 0
    part = matrix / 2.0**squarings
    # The norm is at most 1/2 now: the first omitted term is below 1e-22.
    total = np.eye(len(matrix))
    for n in range(18, 0, -1):
        total = np.eye(len(matrix)) + part @ total / n
    for _ in range(squarings):
        total = total @ total
    return total


class PlantInputs(NamedTuple):
    """Inputs of a plant from tick to tick: intention of the hand, and commanded forces.

    intention  of the hand
    poses      (7 length,)   x, y, z, qw, qx, qy, qz of each pose in turn; an array or a pointer
    line       (DELAY_LINE_SIZE,)  N, delayed forces, updated; zeros before the first tick
    """

    intention: Intention
    poses: Any
    line: Any


@jit
def compute_goal(intention: Intention, poses: Any, number: int) -> tuple[Vec3, Quaternion]:
    """Return the intention of the hand at tick `number`: position (3,) m and orientation.

    poses  (7 length,)  x, y, z, qw, qx, qy, qz of each pose in turn; an array or a pointer
    """
    count = int(intention.length)
    row = 0
    if number < count:
        row = 7 * number
    elif intention.loop != 0.0:
        if count > 1:
            row = 7 * (number % count)
    else:
        row = 7 * (count - 1)
    position = (poses[row], poses[row + 1], poses[row + 2])
    if intention.frequency != 0.0:
        turns = intention.frequency * number
        # remove full turns first: the sine of a large number loses digits
        wave = sin(2.0 * pi * (turns - floor(turns) + intention.phase))
        position = vec3.add_scaled(position, wave, intention.amplitude)
    return position, (poses[row + 3], poses[row + 4], poses[row + 5], poses[row + 6])


@jit
def sense(plant: Plant, state: PlantState) -> Vec3:
    """Return the position (3,) m that the encoders measure, rounded to their resolution."""
    x, y, z = state.position
    if plant.resolution == 0.0:
        return (x, y, z)
    fine, step = plant.per_resolution, plant.resolution
    return (floor(x * fine + 0.5) * step, floor(y * fine + 0.5) * step, floor(z * fine + 0.5) * step)


@jit
def clamp_command(plant: Plant, command: Vec3) -> Vec3:
    """Return the force (3,) N of the motors for a command, limited with unchanged direction."""
    size = vec3.dot(command, command)
    if size <= plant.force_max_squared:
        return command
    return vec3.scale(plant.force_max / sqrt(size), command)


@jit
def flush_small(v: Vec3) -> Vec3:
    """Return a vector with components below `FLUSH_MAX` set to 0: a decaying one would become denormal and slow."""
    x, y, z = v
    return (x if abs(x) >= FLUSH_MAX else 0.0, y if abs(y) >= FLUSH_MAX else 0.0, z if abs(z) >= FLUSH_MAX else 0.0)


@jit
def advance(
    plant: Plant, state: PlantState, command: Vec3, goal: Vec3, orientation: Quaternion, line: Any
) -> PlantState:
    """Return the state after one tick.

    command      (3,) N   written at the start of the tick
    goal         (3,) m   intention of the hand at its end; `state.goal` is the present one
    orientation  (4,)     orientation of the hand at its end, unit quaternion
    line         (DELAY_LINE_SIZE,) N  delayed forces, an array or a pointer; updated. Unused without delay
    """
    u, slot = clamp_command(plant, command), state.slot
    if plant.delay > 0.0:
        at = 3 * int(slot)
        delayed = (line[at], line[at + 1], line[at + 2])
        line[at], line[at + 1], line[at + 2] = u
        u = delayed
        slot = slot + 1.0 if slot + 1.0 < plant.delay else 0.0
    x, v, a, p = state.position, state.velocity, state.force, state.goal
    w = vec3.scale(plant.rate, vec3.sub(goal, p))
    ax, ay, az = plant.axes
    after = flush_small(vec3.add_scaled(u, plant.lag_decay, vec3.sub(a, u)))
    x0, v0 = move(ax, x[0], v[0], a[0], after[0], Inputs(u[0], p[0], w[0], 0.0))
    x1, v1 = move(ay, x[1], v[1], a[1], after[1], Inputs(u[1], p[1], w[1], 0.0))
    x2, v2 = move(az, x[2], v[2], a[2], after[2], Inputs(u[2], p[2], w[2], 0.0))
    return PlantState(
        flush_small((x0, x1, x2)),
        flush_small((v0, v1, v2)),
        after,
        goal,
        follow_orientation(plant, state.orientation, orientation),
        slot,
    )


@jit
def follow_orientation(plant: Plant, orientation: Quaternion, goal: Quaternion) -> Quaternion:
    """Return the orientation after a tick: the angle to the hand's orientation decreases by a constant fraction."""
    if plant.orientation_gain == 1.0:
        return goal
    turn = rotations.log(rotations.relative(goal, orientation))
    return rotations.normalize(rotations.multiply(rotations.exp(vec3.scale(plant.orientation_gain, turn)), orientation))
