"""Meshes on which a proxy once got stuck: thin walls, threads, bars, needles. Vertices in metres."""

import numpy as np
from numpy.typing import ArrayLike

from helpers.hostile_meshes import bar
from helpers.meshes import Mesh, bumpy_sphere, joined, made, moved
from softfinger.tools.accuracy.meshes import triangulate_grid


def turned_about_z(profile: ArrayLike, around: int) -> Mesh:
    """Rotate a closed profile (n, 2) of r and z, m, about the z axis in this number of steps."""
    outline = np.asarray(profile, float)
    angle = 2.0 * np.pi * np.arange(around) / around
    rings = [np.column_stack([r * np.cos(angle), r * np.sin(angle), np.full(around, z)]) for r, z in outline]
    vertices, triangles = triangulate_grid(np.array(rings), rows_meet=True, columns_meet=True)
    return made((vertices, triangles[:, ::-1]))


def tube(outer: float = 0.03, wall: float = 0.0005, length: float = 0.05, around: int = 32) -> Mesh:
    """A tube, open at both ends."""
    half = 0.5 * length
    inner = outer - wall
    return turned_about_z([(outer, -half), (outer, half), (inner, half), (inner, -half)], around)


def cup(outer: float = 0.03, wall: float = 0.0005, depth: float = 0.05, around: int = 48) -> Mesh:
    """A cup, open above; its floor has a hole of 0.01 mm, through which no fingertip fits."""
    hole, half = 1e-5, 0.5 * depth
    inner = outer - wall
    profile = [(hole, -half), (outer, -half), (outer, half), (inner, half), (inner, wall - half), (hole, wall - half)]
    return turned_about_z(profile, around)


def thread(core: float = 0.01, height: float = 0.003, length: float = 0.04, turns: int = 5, around: int = 48) -> Mesh:
    """A screw without a head: a helical ridge on a core."""
    rows = 12 * turns + 1
    z = np.linspace(-0.5 * length, 0.5 * length, rows)
    angle = 2.0 * np.pi * np.arange(around) / around
    phase = (z[:, None] * turns / length - angle / (2.0 * np.pi)) % 1.0
    r = core + height * np.abs(2.0 * phase - 1.0)
    side = np.stack([r * np.cos(angle), r * np.sin(angle), np.broadcast_to(z[:, None], r.shape)], axis=2)
    vertices, sides = triangulate_grid(side, columns_meet=True)
    triangles = sides[:, ::-1].tolist()
    low, high = rows * around, rows * around + 1
    for k in range(around):
        m = (k + 1) % around
        triangles += [(low, m, k), (high, (rows - 1) * around + k, (rows - 1) * around + m)]
    ends = [(0.0, 0.0, -0.5 * length), (0.0, 0.0, 0.5 * length)]
    return made((np.vstack([vertices, ends]), np.array(triangles)))


def lattice(pitch: float = 0.015, bars: int = 3, width: float = 0.001) -> Mesh:
    """Bars along each axis that intersect, 1 mm wide."""
    places = pitch * (np.arange(bars) - 0.5 * (bars - 1))
    half, thin = 0.5 * pitch * bars, 0.5 * width
    meshes = []
    for a in places:
        for b in places:
            meshes.append(moved(bar(half, thin, thin), (0.0, float(a), float(b))))
            meshes.append(moved(bar(thin, half, thin), (float(a), 0.0, float(b))))
            meshes.append(moved(bar(thin, thin, half), (float(a), float(b), 0.0)))
    return joined(*meshes)


def needles(count: int = 9, length: float = 0.03, radius: float = 0.0008, spread: float = 0.02) -> Mesh:
    rng = np.random.default_rng(3)
    angle = 2.0 * np.pi * np.arange(8) / 8
    ring = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), np.full(8, -0.5 * length)])
    corners = np.vstack([ring, [(0.0, 0.0, 0.5 * length), (0.0, 0.0, -0.5 * length)]])
    faces = [face for k in range(8) for face in ((k, (k + 1) % 8, 8), ((k + 1) % 8, k, 9))]
    needle = Mesh(corners, np.array(faces, np.int32))
    return joined(*(moved(needle, (float(x), float(y), 0.0)) for x, y in rng.uniform(-spread, spread, (count, 2))))


KINDS = {
    "tube": tube(),
    "cup": cup(),
    "thread": thread(),
    "lattice": lattice(),
    "needles": needles(),
    "bumpy": bumpy_sphere(24, 0.03, 0.05, 20.0),
}
