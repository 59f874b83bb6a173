"""Defective and extreme meshes: each must be refused with one line, or touched safely."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from helpers import meshes
from helpers.meshes import Mesh
from softfinger.tools.accuracy.meshes import triangulate_grid

Array = NDArray[np.float64]


def bar(x: float, y: float, z: float) -> Mesh:
    """Return the twelve triangles of a box with these half extents, m, wound outward."""
    corners = np.array([(a, b, c) for a in (-x, x) for b in (-y, y) for c in (-z, z)])
    sides = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return meshes.made((corners, np.array([half for a, b, c, d in sides for half in ((a, b, c), (a, c, d))])))


def messy_ball(frequency: int = 12, radius: float = 0.05) -> Mesh:
    """A ball with a third of its triangles duplicated and a third inverted, and triangles without area."""
    ball, rng = meshes.geodesic(frequency, radius), np.random.default_rng(1)
    count = len(ball.triangles)
    triangles = ball.triangles.copy()
    turned = rng.permutation(count)[: count // 3]
    triangles[turned] = triangles[turned][:, ::-1]
    repeated = np.roll(triangles[rng.permutation(count)[: count // 3]], 1, axis=1)
    middles = 0.5 * (ball.vertices[triangles[:50, 0]] + ball.vertices[triangles[:50, 1]])
    on_line = np.stack([triangles[:50, 0], len(ball.vertices) + np.arange(50), triangles[:50, 1]], axis=1)
    pointed = triangles[50:100][:, [0, 0, 1]]
    whole = np.concatenate([triangles, repeated, on_line, pointed])
    return Mesh(np.concatenate([ball.vertices, middles]), rng.permutation(whole).astype(np.int32))


def with_holes(frequency: int = 12, radius: float = 0.05) -> Mesh:
    """A ball without a fifth of its triangles, and without a cap, so that a fingertip can enter."""
    ball, rng = meshes.geodesic(frequency, radius), np.random.default_rng(2)
    middles = ball.vertices[ball.triangles].mean(axis=1)
    is_whole = (rng.uniform(size=len(middles)) > 0.2) & (middles[:, 2] < 0.9 * radius)
    return Mesh(ball.vertices, ball.triangles[is_whole])


def needle_strip(length: float = 0.2, thin: float = 2e-7, count: int = 40) -> Mesh:
    """A sheet in z = 0 with needles along its middle, a millionth as wide as long."""
    sheet = meshes.sheet(length, 1.0, 1, count + 2)
    rows = np.concatenate([[-0.05], thin * (np.arange(count + 1) - 0.5 * count), [0.05]])
    vertices = sheet.vertices.copy()
    vertices[:, 1] = rows[np.round(vertices[:, 1] * (count + 2)).astype(int)]
    return Mesh(vertices, sheet.triangles)


def crumpled(count: int = 40) -> Mesh:
    """Large triangles in all directions that intersect one another."""
    vertices = 0.05 * np.random.default_rng(3).normal(size=(3 * count, 3))
    return Mesh(vertices, np.arange(3 * count, dtype=np.int32).reshape(-1, 3))


def valley(rows: int, wide: float, high: float, half_length: float = 0.1) -> Mesh:
    """Two sheets that meet along y, `wide` m to both sides of it and `high` m up, with this number of rows of quads."""
    y = np.linspace(-half_length, half_length, rows + 1)
    return meshes.made(triangulate_grid(np.array([[(x, v, high * (x != 0.0)) for v in y] for x in (-wide, 0.0, wide)])))


def crevice(angle: float = 0.02) -> Mesh:
    """Two sheets that meet along y at a small angle, rad, with a gap far narrower than the fingertip."""
    return valley(8, 0.2 * np.sin(0.5 * angle), 0.2)


MADE: Final = {
    "slivers": lambda: meshes.cylinder(0.05, 0.1, 1000, 1, ends=False),
    "needles": needle_strip,
    "messy": messy_ball,
    "holes": with_holes,
    "crossing": lambda: meshes.joined(
        meshes.torus(0.05, 0.015, 64, 32), meshes.moved(meshes.geodesic(12, 0.03), (0.05, 0.0, 0.0))
    ),
    "crumpled": crumpled,
    "one": lambda: Mesh(np.array([[-0.05, -0.05, 0.0], [0.05, -0.05, 0.0], [0.0, 0.05, 0.0]]), np.array([[0, 1, 2]])),
    "foil": lambda: bar(0.05, 0.05, 5e-7),
    "crevice": crevice,
    "twice": lambda: meshes.joined(meshes.geodesic(10, 0.05), meshes.geodesic(10, 0.05)),
    "within": lambda: meshes.joined(meshes.geodesic(10, 0.05), meshes.geodesic(13, 0.0499)),
    "bead": lambda: meshes.geodesic(4, 1e-4),
    "planet": lambda: meshes.geodesic(60, 500.0),
    "far": lambda: meshes.moved(meshes.geodesic(12, 0.05), (900.0, -200.0, 300.0)),
    "star": lambda: meshes.bumpy_sphere(24, 0.05, height=0.3),
    "moebius": lambda: meshes.moebius(0.06, 0.04, 96, 6),
}
"""Meshes that must be touched safely, by name: thin, duplicated, inverted, intersecting, missing and single triangles,
triangles without area, close walls, and sizes and positions at the limits."""


MANY: Final = {"crumpled 100k": lambda: crumpled(100_000)}
"""Meshes with so many triangles at about the same distance that a tick cannot examine them all."""


def directions(seed: int, count: int) -> Array:
    """Unit vectors (count, 3) in random directions."""
    some = np.random.default_rng(seed).normal(size=(count, 3))
    return np.asarray(some / np.linalg.norm(some, axis=1, keepdims=True))


def socket(radius: float, frequency: int = 60) -> Mesh:
    """A hollow ball with triangles that are all about as far from its centre as the nearest, `radius` (m)."""
    ball = meshes.geodesic(frequency)
    middles = np.linalg.norm(ball.vertices[ball.triangles].mean(axis=1), axis=1)
    return Mesh(ball.vertices * (radius / middles.min()), ball.triangles)
