"""Meshes from formulas, of any size, whose exact surfaces are known. Vertices in metres, triangles wound outward."""

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.tools.accuracy import meshes as surfaces

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
    499280."""
    points, triangles = surfaces.make_geodesic(np.array(CORNERS), FACES, frequency)
    return made((radius * points, triangles))


def bumpy_sphere(frequency: int, radius: float = 1.0, height: float = 0.02, waves: float = 20.0) -> Mesh:
    """A ball of 20 * frequency^2 triangles with bumps: its surface in the unit direction (x, y, z) is at

    radius + height sin(waves x) sin(waves y) sin(waves z).
    """
    ball = geodesic(frequency)
    bumps = np.sin(waves * ball.vertices).prod(axis=1, keepdims=True)
    return Mesh(ball.vertices * (radius + height * bumps), ball.triangles)


def torus(major: float = 1.0, minor: float = 0.4, along: int = 64, around: int = 32) -> Mesh:
    """A ring about the z axis with `along` segments of `around` vertices: 2 * along * around triangles."""
    return made(surfaces.make_ring(major, minor, along, around))


def cylinder(radius: float = 1.0, length: float = 2.0, around: int = 64, along: int = 1, ends: bool = True) -> Mesh:
    """A cylinder about the z axis, centred: 2 * around * along triangles, and 2 * around of the flat ends."""
    points, sides = surfaces.make_tube(radius, length, around, along)
    if not ends:
        return made((points, sides))
    bottom, top, last = len(points), len(points) + 1, along * around
    here = np.arange(around)
    next_corner = (here + 1) % around
    ends_of = [
        np.stack([np.full(around, bottom), next_corner, here], axis=1),
        np.stack([np.full(around, top), last + here, last + next_corner], axis=1),
    ]
    middles = [(0.0, 0.0, -0.5 * length), (0.0, 0.0, 0.5 * length)]
    return made((np.concatenate([points, middles]), np.concatenate([sides, *ends_of])))


def sheet(width: float = 1.0, depth: float = 1.0, columns: int = 8, rows: int = 8) -> Mesh:
    """An open rectangle in the plane z = 0 from the origin, normal +z: 2 * columns * rows triangles."""
    x, y = np.linspace(0.0, width, columns + 1), np.linspace(0.0, depth, rows + 1)
    return made(
        surfaces.triangulate_grid(np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((len(x), len(y)))], axis=-1))
    )


def moebius(radius: float = 1.0, width: float = 0.5, along: int = 64, across: int = 4) -> Mesh:
    """A Moebius strip: it has one side, and no winding is consistent for all 2 * along * across triangles."""
    u = 2.0 * math.pi * np.arange(along)[:, None] / along
    v = width * (np.arange(across + 1) / across - 0.5)
    out = radius + v * np.cos(0.5 * u)
    points = np.stack([out * np.cos(u), out * np.sin(u), v * np.sin(0.5 * u)], axis=-1)
    at = np.arange(along * (across + 1)).reshape(along, across + 1)
    return made((points.reshape(-1, 3), surfaces.triangulate_cells(np.concatenate([at, at[:1, ::-1]]))))


def made(surface: surfaces.Arrays) -> Mesh:
    points, triangles = surface
    return Mesh(points, np.ascontiguousarray(triangles, np.int32))


def joined(*meshes: Mesh) -> Mesh:
    """Combine several meshes; they share no vertex."""
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
