"""Meshes from formulas, of any size, whose exact surfaces are known. Vertices in metres, triangles wound outward."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Vertices = NDArray[np.float64]
Triangles = NDArray[np.int32]

GOLDEN = 0.5 * (1.0 + math.sqrt(5.0))
CORNERS = [
    (-1.0, GOLDEN, 0.0), (1.0, GOLDEN, 0.0), (-1.0, -GOLDEN, 0.0), (1.0, -GOLDEN, 0.0),
    (0.0, -1.0, GOLDEN), (0.0, 1.0, GOLDEN), (0.0, -1.0, -GOLDEN), (0.0, 1.0, -GOLDEN),
    (GOLDEN, 0.0, -1.0), (GOLDEN, 0.0, 1.0), (-GOLDEN, 0.0, -1.0), (-GOLDEN, 0.0, 1.0),
]  # fmt: skip
FACES = [
    (0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11),
    (1, 5, 9), (5, 11, 4), (11, 10, 2), (10, 7, 6), (7, 1, 8),
    (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8), (3, 8, 9),
    (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1),
]  # fmt: skip
"""Faces of the icosahedron, wound outward."""


class Mesh(NamedTuple):
    """Vertices float64 (n, 3), m, and triangles int32 (m, 3): indices of vertices."""

    vertices: Vertices
    triangles: Triangles


def icosphere(divisions: int, radius: float = 1.0) -> Mesh:
    """A ball of 20 * 4^divisions triangles."""
    return geodesic(2**divisions, radius)


def geodesic(frequency: int, radius: float = 1.0) -> Mesh:
    """A ball of 20 * frequency^2 triangles: the faces of an icosahedron, divided in rows and projected; 158 gives
    499280.

    Each vertex is unique, in the order: corners, along edges, within faces.
    """
    n = frequency
    corners = np.array(CORNERS)
    edges = {pair: number for number, pair in enumerate((a, b) for f in FACES for a, b in _sides(f) if a < b)}
    inside = (n - 1) * (n - 2) // 2
    points = np.empty((12 + 30 * (n - 1) + 20 * inside, 3))
    points[:12] = corners
    share = np.arange(1, n)[:, None] / n
    for (a, b), number in edges.items():
        start = 12 + number * (n - 1)
        points[start : start + n - 1] = (1.0 - share) * corners[a] + share * corners[b]
    i, j = (axis.ravel() for axis in np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij"))
    within = (i > 0) & (j > 0) & (i + j < n)
    triangles = []
    for face, (a, b, c) in enumerate(FACES):
        start = 12 + 30 * (n - 1) + face * inside
        u, v = i[within, None] / n, j[within, None] / n
        points[start : start + inside] = (1.0 - u - v) * corners[a] + u * corners[b] + v * corners[c]
        at = np.full((n + 1, n + 1), -1)  # index of the vertex i steps towards b and j towards c
        at[0, 0], at[n, 0], at[0, n] = a, b, c
        steps = np.arange(1, n)
        at[steps, 0] = _along(edges, a, b, n)
        at[0, steps] = _along(edges, a, c, n)
        at[n - steps, steps] = _along(edges, b, c, n)
        at[i[within], j[within]] = start + np.arange(inside)
        up, down = i + j < n, (i > 0) & (j > 0) & (i + j <= n)
        triangles.append(np.stack([at[i[up], j[up]], at[i[up] + 1, j[up]], at[i[up], j[up] + 1]], axis=1))
        i1, j1 = i[down], j[down]
        triangles.append(np.stack([at[i1, j1], at[i1 - 1, j1], at[i1, j1 - 1]], axis=1))
    points *= radius / np.linalg.norm(points, axis=1, keepdims=True)
    return Mesh(points, np.concatenate(triangles).astype(np.int32))


def bumpy_sphere(frequency: int, radius: float = 1.0, height: float = 0.02, waves: float = 20.0) -> Mesh:
    """A ball of 20 * frequency^2 triangles with bumps: its surface in the unit direction (x, y, z) is at

    radius + height sin(waves x) sin(waves y) sin(waves z).
    """
    ball = geodesic(frequency)
    bumps = np.sin(waves * ball.vertices).prod(axis=1, keepdims=True)
    return Mesh(ball.vertices * (radius + height * bumps), ball.triangles)


def torus(major: float = 1.0, minor: float = 0.4, along: int = 64, around: int = 32) -> Mesh:
    """A ring about the z axis with `along` segments of `around` vertices: 2 * along * around triangles."""
    u, v = (2.0 * math.pi * np.arange(count) / count for count in (along, around))
    out = major + minor * np.cos(v)
    points = np.empty((along, around, 3))
    points[..., 0] = np.cos(u)[:, None] * out
    points[..., 1] = np.sin(u)[:, None] * out
    points[..., 2] = minor * np.sin(v)
    return Mesh(points.reshape(-1, 3), _grid(along, around, True, True))


def cylinder(radius: float = 1.0, length: float = 2.0, around: int = 64, along: int = 1, ends: bool = True) -> Mesh:
    """A cylinder about the z axis, centred: 2 * around * along triangles, and 2 * around of the flat ends."""
    u = 2.0 * math.pi * np.arange(around) / around
    points = np.empty((along + 1, around, 3))
    points[..., 0], points[..., 1] = radius * np.cos(u), radius * np.sin(u)
    points[..., 2] = length * (np.arange(along + 1)[:, None] / along - 0.5)
    sides = _grid(along + 1, around, False, True)[:, ::-1]
    if not ends:
        return Mesh(points.reshape(-1, 3), np.ascontiguousarray(sides))
    bottom, top, last = (along + 1) * around, (along + 1) * around + 1, along * around
    here = np.arange(around)
    next_corner = (here + 1) % around
    ends_of = [
        np.stack([np.full(around, bottom), next_corner, here], axis=1),
        np.stack([np.full(around, top), last + here, last + next_corner], axis=1),
    ]
    middles = [(0.0, 0.0, -0.5 * length), (0.0, 0.0, 0.5 * length)]
    return Mesh(np.concatenate([points.reshape(-1, 3), middles]), np.concatenate([sides, *ends_of]).astype(np.int32))


def sheet(width: float = 1.0, depth: float = 1.0, columns: int = 8, rows: int = 8) -> Mesh:
    """An open rectangle in the plane z = 0 from the origin, normal +z: 2 * columns * rows triangles."""
    points = np.zeros((columns + 1, rows + 1, 3))
    points[..., 0] = width * (np.arange(columns + 1) / columns)[:, None]
    points[..., 1] = depth * (np.arange(rows + 1) / rows)
    return Mesh(points.reshape(-1, 3), _grid(columns + 1, rows + 1, False, False))


def moebius(radius: float = 1.0, width: float = 0.5, along: int = 64, across: int = 4) -> Mesh:
    """A Moebius strip: it has one side, and no winding is consistent for all 2 * along * across triangles."""
    u = 2.0 * math.pi * np.arange(along)[:, None] / along
    v = width * (np.arange(across + 1) / across - 0.5)
    out = radius + v * np.cos(0.5 * u)
    points = np.stack([out * np.cos(u), out * np.sin(u), v * np.sin(0.5 * u)], axis=-1)
    at = np.arange(along * (across + 1)).reshape(along, across + 1)
    return Mesh(points.reshape(-1, 3), _split(np.concatenate([at, at[:1, ::-1]])))


def joined(*meshes: Mesh) -> Mesh:
    """Combine several meshes, each with its own vertices."""
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    triangles = [mesh.triangles + start for mesh, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([mesh.vertices for mesh in meshes]), np.concatenate(triangles).astype(np.int32))


def moved(mesh: Mesh, by: tuple[float, float, float]) -> Mesh:
    return Mesh(mesh.vertices + np.array(by), mesh.triangles)


def write_ply(path: Path, mesh: Mesh, kind: str = "float") -> Path:
    """Write a binary PLY file with coordinates as float (32 bits) or double."""
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(mesh.vertices)}\n"
        f"property {kind} x\nproperty {kind} y\nproperty {kind} z\n"
        f"element face {len(mesh.triangles)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    rows = np.empty(len(mesh.triangles), [("count", "u1"), ("corners", "<i4", 3)])
    rows["count"], rows["corners"] = 3, mesh.triangles
    points = mesh.vertices.astype({"float": "<f4", "double": "<f8"}[kind])
    path.write_bytes(head.encode() + points.tobytes() + rows.tobytes())
    return path


def volume(mesh: Mesh) -> float:
    """Return the enclosed volume, m^3; negative if wound inward."""
    a, b, c = (mesh.vertices[mesh.triangles[:, corner]] for corner in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def _sides(face: tuple[int, int, int]) -> list[tuple[int, int]]:
    a, b, c = face
    return [(a, b), (b, c), (c, a)]


def _along(edges: dict[tuple[int, int], int], a: int, b: int, n: int) -> NDArray[np.int64]:
    """Return the n - 1 vertices between two corners, from a to b."""
    row = 12 + edges[min(a, b), max(a, b)] * (n - 1) + np.arange(n - 1)
    return row if a < b else row[::-1]


def _grid(rows: int, columns: int, rows_meet: bool, columns_meet: bool) -> Triangles:
    """Return the triangles of a grid of vertices, by rows; the last row (column) may connect to the first."""
    at = np.arange(rows * columns).reshape(rows, columns)
    if rows_meet:
        at = np.concatenate([at, at[:1]])
    if columns_meet:
        at = np.concatenate([at, at[:, :1]], axis=1)
    return _split(at)


def _split(at: NDArray[np.int64]) -> Triangles:
    """Return two triangles per cell of a grid of indices, wound from the rows' direction towards the columns'."""
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]).astype(np.int32)
