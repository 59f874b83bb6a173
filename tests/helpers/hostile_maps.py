"""Extreme height maps, hands that move wildly on them, and an exhaustive search over all their points."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from helpers.touching import R, make_object, wander

Array = NDArray[np.float64]

TICKS: Final = 300
STIFFNESS: Final = 1000.0
FINE: Final = 4
"""Search points per pixel."""


def noise(count: int, height: float) -> Array:
    return np.random.default_rng(1).uniform(-height, height, (count, count))


def columns(count: int, height: float, every: int) -> Array:
    """A needle of one pixel every few pixels; 2 gives a checkerboard."""
    y, x = np.indices((count, count))
    return height * ((x % every == 0) & (y % every == 0) | (every == 2) & (x % 2 == 1) & (y % 2 == 1))


def steps(count: int, height: float, wide: int) -> Array:
    y, x = np.indices((count, count)) // wide
    return height * ((x + y) % 2)


def pit(count: int, pitch: float, radius: float) -> Array:
    """Half a ball with its rim at 0."""
    y, x = (np.indices((count, count)) - 0.5 * (count - 1)) * pitch
    return -np.sqrt(np.maximum(radius * radius - x * x - y * y, 0.0))


MADE: Final[dict[str, Callable[[], tuple[float, Array]]]] = {
    "flat": lambda: (5e-4, np.zeros((64, 64))),
    "two": lambda: (1e-3, np.array([[0.0, 0.02]])),
    "noise": lambda: (5e-4, noise(80, 5e-4)),
    "high noise": lambda: (1e-3, noise(60, 0.02)),
    "needles": lambda: (5e-4, columns(80, 0.01, 8)),
    "checkerboard": lambda: (5e-4, columns(80, 0.01, 2)),
    "steps": lambda: (1e-3, steps(60, 0.02, 9)),
    "pit": lambda: (4e-4, pit(80, 4e-4, R)),
    "wider pit": lambda: (4e-4, pit(80, 4e-4, 1.0005 * R)),
}


def weights_at(places: Array, count: float) -> Array:
    """Return weights of `count` + 3 coefficients at positions (n,) in cells, by sums of truncated powers."""
    apart = np.abs(np.clip(places, 0.0, count)[:, None] + 1.0 - np.arange(int(count) + 3))
    weights: Array = (np.maximum(2.0 - apart, 0.0) ** 3 - 4.0 * np.maximum(1.0 - apart, 0.0) ** 3) / 6.0
    return weights


def grid_of(shape: Any, x: Array, y: Array) -> Array:
    """Return points (n, 3) m of the map over a grid of x and y, m, computed with numpy only."""
    across = weights_at(x / shape.pitch + 0.5 * shape.columns, shape.columns)
    down = weights_at(y / shape.pitch + 0.5 * shape.rows, shape.rows)
    heights = down @ shape.coefficients.array.reshape(down.shape[1], across.shape[1]) @ across.T
    at_x, at_y = np.meshgrid(x, y)
    return np.column_stack([at_x.ravel(), at_y.ravel(), shape.pitch * heights.ravel()])


def surface(shape: Any, beyond: float) -> Array:
    """Return points (n, 3) m of the map, FINE per pixel along x and y, and of its flat border to the same distance."""
    half = 0.5 * max(shape.columns, shape.rows) * shape.pitch + beyond
    return grid_of(shape, *[np.arange(-half, half, shape.pitch / FINE)] * 2)


def outside_by(shape: Any, centers: Array) -> float:
    """Return the distance (m) of fingertip centres (n, 3) from the nearest of all search points, minus the radius."""
    away, _ = KDTree(surface(shape, 3e-3)).query(np.unique(centers, axis=0))
    return float(away.min()) - R


def hands(heights: Array, pitch: float) -> dict[str, Array]:
    """Return points (TICKS, 3) m: dragged through all heights at a metre per tick, and pressed into the centre."""
    half, low, high = 0.5 * pitch * max(heights.shape), heights.min(), heights.max()
    rng = np.random.default_rng(5)
    dragged = wander(3, TICKS, 1.0, 0.03) * (half, half, 0.5 * (high - low) + 0.3 * R)
    dragged[:, 2] += 0.5 * (low + high) + R
    thrown = rng.normal(size=(TICKS, 3))
    thrown /= 2.0 * np.linalg.norm(thrown, axis=1, keepdims=True)
    middle = 0.02 * R * rng.normal(size=(TICKS, 3)) + (0.0, 0.0, 0.5 * (low + high))
    middle[:100, 2] = np.linspace(high + 2.0 * R, middle[100, 2], 100)
    return {"dragged": dragged, "thrown": thrown, "middle": middle}


def part(folder: Path, heights: Array, pitch: float, **keys: Any) -> dict[str, Any]:
    file = folder / "map.npy"
    np.save(file, heights)
    return make_object("part", "heightmap", file=str(file), pitch_m=pitch, level_m=1.0, **keys)
