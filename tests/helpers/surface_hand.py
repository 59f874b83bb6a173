"""Hand that presses, drags and lifts at random on a mesh, of which it knows only the vertices."""

import numpy as np
from numpy.typing import NDArray
from references.brute_force import Balls, balls_of, brute_distances

from helpers.meshes import Mesh
from helpers.touching import posed, spun

Array = NDArray[np.float64]

SPEEDS = (0.02, 0.5)
"""Range of the hand's speed, m/s."""
DEPTHS = (0.005, 2.0)
"""Range of the depth of the press, in radii of the fingertip."""
SPAN = (1.0, 8.0)
"""Length of a drag, and of most moves through the air, in radii."""
FAR = 0.1
"""Share of the moves through the air that may go anywhere."""
TICK_S = 1e-3


def normals_of(vertices: Array, triangles: NDArray[np.int32]) -> Array:
    """Return mean unit normals (n, 3) at the vertices by area; arbitrary without a triangle."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    across = np.cross(b - a, c - a)
    total = np.zeros_like(vertices)
    for i in range(3):
        np.add.at(total, triangles[:, i], across)
    size = np.linalg.norm(total, axis=1, keepdims=True)
    return np.where(size > 0.0, total / np.where(size > 0.0, size, 1.0), (0.0, 0.0, 1.0))


def outside_at(balls: Balls, vertices: Array, normals: Array, radius: float, rng: np.random.Generator) -> int:
    """Return a vertex above which a fingertip at a height of two radii is outside."""
    some = rng.integers(len(vertices), size=100)
    free = brute_distances(balls, vertices[some] + 2.0 * radius * normals[some]) > 1.01 * radius
    return int(some[int(free.argmax())])


def vertex_path(vertices: Array, normals: Array, at: int, ticks: int, radius: float, rng: np.random.Generator) -> Array:
    """Return points (ticks, 3) m of the fingertip's centre: onto vertex `at`, to its neighbours, up, to the next."""
    corners, times = [vertices[at] + 2.0 * radius * normals[at]], [0.0]

    def go_to(height: float) -> None:
        point = vertices[at] + height * normals[at]
        speed = np.exp(rng.uniform(*np.log(SPEEDS)))
        times.append(times[-1] + float(np.linalg.norm(point - corners[-1])) / speed)
        corners.append(point)

    while times[-1] < ticks * TICK_S:
        depth = radius * np.exp(rng.uniform(*np.log(DEPTHS)))
        go_to(2.0 * radius)
        go_to(radius - depth)
        for _ in range(int(rng.integers(0, 5))):
            at = neighbour_of(vertices, at, radius, rng)
            go_to(radius - depth)
        go_to(2.0 * radius)
        at = int(rng.integers(len(vertices))) if rng.uniform() < FAR else neighbour_of(vertices, at, radius, rng)
    at_ticks = TICK_S * np.arange(ticks)
    return np.stack([np.interp(at_ticks, times, axis) for axis in np.array(corners).T], axis=1)


def neighbour_of(vertices: Array, at: int, radius: float, rng: np.random.Generator) -> int:
    """Return a vertex close to another, or that vertex if there is none."""
    others = rng.integers(len(vertices), size=2000)
    apart = np.linalg.norm(vertices[others] - vertices[at], axis=1)
    near = others[(apart >= SPAN[0] * radius) & (apart <= SPAN[1] * radius)]
    return int(near[0]) if len(near) else at


def hand(mesh: Mesh, ticks: int, radius: float, rng: np.random.Generator) -> Array:
    """Return poses (ticks, 7) that turn back and forth about an axis at up to 2 rad/s."""
    points, corners = mesh
    used = np.unique(corners)
    vertices, normals = points[used], normals_of(points, corners)[used]
    at = outside_at(balls_of(points, corners), vertices, normals, radius, rng)
    axis = rng.normal(size=3)
    turned = spun(axis / np.linalg.norm(axis), np.sin(2.0 * TICK_S * np.arange(ticks)))
    return posed(vertex_path(vertices, normals, at, ticks, radius, rng), turned)
