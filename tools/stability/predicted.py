"""What theory says of a sampled virtual wall: its exact linear stability limit and its passivity bound.

A mass m with damping b (and a hand that holds it) moves under a force that is held for a tick of T. The
wall commands, d ticks late,

    F[k] = -K x[k-d] - B v[k-d]        v[k] = (x[k] - x[k-1]) / T, or that through a first-order low-pass

Source of the loop and of the bound: Colgate and Schenkel (1997), passivity of a class of sampled-data
systems. Of the simulation that it is compared with, nothing but the matrix exponential is used here.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from softfinger.drivers.simulated.plant import expm
from softfinger.tools.measure import Array

RADIUS_TOLERANCE: Final = 1e-12
"""A spectral radius above 1 by less is rounding: single eigenvalues near 1 are found to about 1e-15 times the
condition of a matrix of a few rows."""
RATIO: Final = 1.05
"""Of one stiffness of the grid to the next."""
LOWEST: Final = 1e-3
"""The first stiffness tried, as a share of what all damping together would make stable in a slow loop; without
damping, its square as a share of the scale above which no wall is stable."""


class LinearLoop(NamedTuple):
    """A wall in closed loop with a linear device, one axis.

    mass, damping                kg, N s/m       of the device along the axis
    wall_damping                 N s/m           B
    period                       s               T
    delay                        ticks           d, from sensing to the force that answers
    velocity_time_constant       s               of the filter of v; 0: none
    hand_stiffness, hand_damping N/m, N s/m      of the hand against its intention, which stands still
    """

    mass: float
    damping: float
    wall_damping: float
    period: float
    delay: int
    velocity_time_constant: float = 0.0
    hand_stiffness: float = 0.0
    hand_damping: float = 0.0


def held(loop: LinearLoop) -> tuple[Array, Array]:
    """Position and velocity after a tick of constant force: phi (2, 2) and gamma (2,), exact.

    From the exponential of the motion with the force as a third state that does not change.
    """
    rate = np.zeros((3, 3))
    rate[0, 1] = 1.0
    rate[1] = -loop.hand_stiffness, -(loop.damping + loop.hand_damping), 1.0
    rate[1] /= loop.mass
    after = expm(rate * loop.period)
    return after[:2, :2], after[:2, 2]


def closed_loop(loop: LinearLoop) -> tuple[Array, Array]:
    """Matrices (n, n) whose sum M0 + K M1 takes the state over a tick; n = 4 + d.

    The state: position and velocity, the last tick's sensed position and filtered velocity, and the d
    commands under way, oldest first.
    """
    phi, gamma = held(loop)
    d = loop.delay
    gain = 1.0 / (loop.velocity_time_constant + loop.period)
    velocity, wall = np.zeros(4 + d), np.zeros(4 + d)  # rows: what the servo makes of the state
    velocity[[0, 2, 3]] = gain, -gain, loop.velocity_time_constant * gain
    wall[0] = -1.0
    m0, m1 = np.zeros((4 + d, 4 + d)), np.zeros((4 + d, 4 + d))
    m0[:2, :2] = phi
    m0[2, 0] = 1.0
    m0[3] = velocity
    for under_way in range(4, 3 + d):
        m0[under_way, under_way + 1] = 1.0
    damper = -loop.wall_damping * velocity
    if d == 0:
        m0[:2] += np.outer(gamma, damper)
        m1[:2] = np.outer(gamma, wall)
    else:
        m0[:2, 4] += gamma
        m0[3 + d], m1[3 + d] = damper, wall
    return m0, m1


def spectral_radius(loop: LinearLoop, stiffness: Array) -> Array:
    """Largest modulus of the eigenvalues of the closed loop for each of `stiffness` (n,) N/m."""
    m0, m1 = closed_loop(loop)
    found: Array = np.abs(np.linalg.eigvals(m0 + np.multiply.outer(stiffness, m1))).max(axis=-1)
    return found


def linear_limit(loop: LinearLoop) -> float:
    """The stiffness, N/m, at which a wall made ever stiffer first turns unstable; 0 where the softest already is.

    The first crossing is meant: with a hand, with delay or with much wall damping the stable stiffnesses
    need not be one interval, and a wall that is stable again further up cannot be reached by stiffening it.
    It is looked for on a grid of ratio RATIO and then bisected to the last digit; a window of instability
    narrower than a step of the grid, followed by stability, would be passed over.
    """
    damping, period = loop.damping + loop.hand_damping, loop.period
    top = 8.0 * (loop.mass / period**2 + damping / period) + loop.hand_stiffness
    # A slow loop turns unstable at K (T / 2 + d T) = b + B.
    slow = (damping + loop.wall_damping) / ((loop.delay + 0.5) * period)
    bottom = min(LOWEST * slow if slow > 0.0 else top, LOWEST**2 * top)
    grid = np.geomspace(bottom, top, 1 + int(np.log(top / bottom) / np.log(RATIO)))
    unstable = spectral_radius(loop, grid) > 1.0 + RADIUS_TOLERANCE
    if not unstable.any():
        raise ArithmeticError(f"no wall up to {top:g} N/m is unstable: {loop}")
    first = int(unstable.argmax())
    if first == 0:
        return 0.0
    low, high = float(grid[first - 1]), float(grid[first])
    while True:
        middle = 0.5 * (low + high)
        if not low < middle < high:
            return low
        if spectral_radius(loop, np.array([middle]))[0] > 1.0 + RADIUS_TOLERANCE:
            high = middle
        else:
            low = middle


def passive_limit(loop: LinearLoop) -> float:
    """The largest stiffness, N/m, of a wall that is passive: it feeds no energy to whatever holds the device.

    b > K T / 2 + |B|, the bound of Colgate and Schenkel. With d ticks of delay their condition,
    b > T / 2 / (1 - cos a) Re((1 - e^(-j a)) H(e^(j a))) for all a, reads b > (K T / 2) D(a) - B cos((d + 1) a)
    with D(a) = sin((d + 1/2) a) / sin(a / 2) <= 2 d + 1: the wall is passive where b > (2 d + 1) K T / 2 + |B|.
    For d = 0 that is the bound itself, beyond it is sufficient. A velocity filter only lessens B's part.
    """
    return max(0.0, 2.0 * (loop.damping - abs(loop.wall_damping)) / ((2 * loop.delay + 1) * loop.period))
