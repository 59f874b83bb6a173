"""Count the reads of height maps per tick: `python -m helpers.counted_asks` in tests/, with the scenes on standard
input.

Requires NUMBA_DISABLE_JIT=1: kernels are then plain Python, so a function that reads a map can count its calls. Input:
[[rolling method, objects, points (n, 3)], ...]. Output, per scene: the reads of each tick and the proxies.
"""

import json
import sys
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

QUESTION: Final = 2 * (5 + 2 * 48) + 4 * 24 + 9
"""Reads of one query beyond its budget: the current cell, and the tiles on the way out and around one foot."""
ALONE: Final = 600 + 2 * 300 + 1000 + 1152 + 5 * QUESTION
"""Reads for a roll, for the check of room at two ends, for a first touch and for coming to rest."""
IN_COMPANY: Final = ALONE + 1536 // 4 + 3 * QUESTION
"""Reads of one map in a tick with other objects: those without other objects, a quarter of the shared budget, the last
query's excess, and one foot each at start and end."""


def poses_at(points: ArrayLike) -> Array:
    """Return poses (n, 7) at `points` (n, 3) m, turning by up to a third of a radian per tick."""
    from helpers.touching import posed, spun

    places = np.asarray(points, float)
    return posed(places, spun((0.6, 0.0, 0.8), 0.3 * np.arange(len(places))))


def count(scenes: list[Any]) -> list[Any]:
    from helpers.touching import scene_with
    from softfinger.proxy.kernels.jit.decorators import PLAIN
    from softfinger.proxy.kernels.model import Pose
    from softfinger.proxy.kernels.shapes.heightmap import nearest, surface, tiles
    from softfinger.proxy.kernels.step import step
    from softfinger.proxy.scene import build_scene, start_state

    assert PLAIN
    lookups = 0

    def counted(kernel: Any, cost: int) -> Any:
        def call(*args: Any) -> Any:
            nonlocal lookups
            lookups += cost
            return kernel(*args)

        return call

    tiles.find_tile = nearest.find_tile = counted(tiles.find_tile, 1)
    surface.compute_height = counted(surface.compute_height, nearest.HEIGHT_COST)
    results = []
    for method, objects, points in scenes:
        tree = build_scene(scene_with(*objects, rolling={"method": method}))
        state, per_tick, centers = start_state(tree), [], []
        for x, y, z, *turned in poses_at(points).tolist():
            lookups = 0
            state, (contact,) = step(tree, state, (Pose((x, y, z), tuple(turned)),), 1e-3)
            per_tick.append(lookups)
            centers.append([float(v) for v in contact.center])
        results.append((per_tick, centers))
    return results


if __name__ == "__main__":
    print(json.dumps(count(json.load(sys.stdin))))
