"""Goals of simulated hands along straight lines and constant turns, planned in each step of an environment."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.numerics import rotations

Array = NDArray[np.float64]


@entry
def plan_goals(goals: Array, velocities: Array, lowest: Array, highest: Array, dt: float) -> None:
    """Fill `goals` (n, hands, 7), poses `dt` s apart, from the first of them on.

    velocities       (hands, 6) m/s, rad/s  linear along x, y, z, then angular about them, world frame
    lowest, highest  (hands, 3) m           bounds of the positions
    """
    for hand in range(goals.shape[1]):
        start = goals[0, hand]
        a, b, c = velocities[hand, 3], velocities[hand, 4], velocities[hand, 5]
        orientation = (start[3], start[4], start[5], start[6])
        for i in range(goals.shape[0]):
            t = i * dt
            for k in range(3):
                position = start[k] + t * velocities[hand, k]
                goals[i, hand, k] = min(max(position, lowest[hand, k]), highest[hand, k])
            q = orientation
            if a != 0.0 or b != 0.0 or c != 0.0:
                q = rotations.normalize(rotations.multiply(rotations.exp((t * a, t * b, t * c)), orientation))
            for k in range(4):
                goals[i, hand, 3 + k] = q[k]
