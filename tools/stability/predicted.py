"""Theory of a sampled virtual wall: its exact linear stability limit and its passivity bound.

A mass m with damping b (and a hand at it) moves under a force that is constant during a tick of T. The wall commands, d
ticks late,

    F[k] = -K x[k-d] - B v[k-d]        v[k] = (x[k] - x[k-1]) / T, or that through a first-order low-pass

Source of the loop and of the bound: Colgate and Schenkel (1997), passivity of a class of sampled-data systems. Only the
matrix exponential is shared with the simulation that it is compared with.
"""

from __future__ import annotations

from typing import Final, NamedTuple

import numpy as np

from softfinger.drivers.simulated.plant import expm
from softfinger.tools.measure import Array

RADIUS_TOLERANCE: Final = 1e-12
"""Excess of a spectral radius above 1 that is rounding.

Single eigenvalues near 1 are accurate to about 1e-15 times the condition of a matrix of a few rows.
"""
RATIO: Final = 1.05
"""Ratio of neighbouring stiffnesses of the grid."""
FIRST_STIFFNESS_SHARE: Final = 1e-3
"""First stiffness of the grid, as a fraction of the stable limit of a slow loop with all damping together.

Without damping, the first stiffness is its square times the scale above which no wall is stable.
"""


class LinearLoop(NamedTuple):
    """Wall in closed loop with a linear device, one axis.

    mass, damping                kg, N s/m       of the device along the axis
    wall_damping                 N s/m           B
    period                       s               T
    delay                        ticks           d, from sensing to the resulting force
    velocity_time_constant       s               of the filter of v; 0: none
    hand_stiffness, hand_damping N/m, N s/m      of the hand against its intention, which is at rest
    """

    mass: float
    damping: float
    wall_damping: float
    period: float
    delay: int
    velocity_time_constant: float = 0.0
    hand_stiffness: float = 0.0
    hand_damping: float = 0.0


def hold_force(loop: LinearLoop) -> tuple[Array, Array]:
    """Return position and velocity after a tick of constant force: phi (2, 2) and gamma (2,), exact.

    They follow from the exponential of the motion with the constant force as a third state.
    """
    rate = np.zeros((3, 3))
    rate[0, 1] = 1.0
    rate[1] = -loop.hand_stiffness, -(loop.damping + loop.hand_damping), 1.0
    rate[1] /= loop.mass
    after = expm(rate * loop.period)
    return after[:2, :2], after[:2, 2]


def make_closed_loop(loop: LinearLoop) -> tuple[Array, Array]:
    """Return matrices (n, n) with the sum M0 + K M1 that advances the state by a tick; n = 4 + d.

    The state has position and velocity, sensed position and filtered velocity of the last tick, and the d delayed
    commands, oldest first.
    """
    phi, gamma = hold_force(loop)
    d = loop.delay
    gain = 1.0 / (loop.velocity_time_constant + loop.period)
    velocity, wall = np.zeros(4 + d), np.zeros(4 + d)  # rows: outputs of the servo for a state
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


def compute_spectral_radius(loop: LinearLoop, stiffness: Array) -> Array:
    """Return the largest modulus of the eigenvalues of the closed loop for each of `stiffness` (n,) N/m."""
    m0, m1 = make_closed_loop(loop)
    radius: Array = np.abs(np.linalg.eigvals(m0 + np.multiply.outer(stiffness, m1))).max(axis=-1)
    return radius


def find_linear_limit(loop: LinearLoop) -> float:
    """Return the stiffness, N/m, at which a wall of increasing stiffness first becomes unstable; 0 if the softest is.

    It is the first crossing. With a hand, with delay or with much wall damping, the stable stiffnesses need not be one
    interval, and increasing the stiffness cannot reach a stable range further up. The crossing is searched on a grid of
    ratio RATIO and then bisected to the last digit. A window of instability narrower than a step of the grid, followed
    by stability, would be missed.
    """
    damping, period = loop.damping + loop.hand_damping, loop.period
    top = 8.0 * (loop.mass / period**2 + damping / period) + loop.hand_stiffness
    # A slow loop becomes unstable at K (T / 2 + d T) = b + B.
    slow = (damping + loop.wall_damping) / ((loop.delay + 0.5) * period)
    bottom = min(FIRST_STIFFNESS_SHARE * slow if slow > 0.0 else top, FIRST_STIFFNESS_SHARE**2 * top)
    grid = np.geomspace(bottom, top, 1 + int(np.log(top / bottom) / np.log(RATIO)))
    unstable = compute_spectral_radius(loop, grid) > 1.0 + RADIUS_TOLERANCE
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
        if compute_spectral_radius(loop, np.array([middle]))[0] > 1.0 + RADIUS_TOLERANCE:
            high = middle
        else:
            low = middle


def compute_passive_limit(loop: LinearLoop) -> float:
    """Return the largest stiffness, N/m, of a passive wall, which feeds no energy to any load of the device.

    b > K T / 2 + |B|, the bound of Colgate and Schenkel. With d ticks of delay their condition,
    b > T / 2 / (1 - cos a) Re((1 - e^(-j a)) H(e^(j a))) for all a, reads b > (K T / 2) D(a) - B cos((d + 1) a)
    with D(a) = sin((d + 1/2) a) / sin(a / 2) <= 2 d + 1: the wall is passive if b > (2 d + 1) K T / 2 + |B|.
    For d = 0 this is the bound itself, for a larger d it is sufficient. A velocity filter only reduces the part of B.
    """
    return max(0.0, 2.0 * (loop.damping - abs(loop.wall_damping)) / ((2 * loop.delay + 1) * loop.period))
