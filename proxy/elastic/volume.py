"""Volume mesh of an elastic body: from its surface by gmsh, or from a file of tetrahedra by meshio."""

from __future__ import annotations

import os
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config import limits

Doubles = NDArray[np.float64]
Whole = NDArray[np.int64]

FACES: Final = ((1, 2, 3), (0, 3, 2), (0, 1, 3), (0, 2, 1))
"""Vertices of the faces of a tetrahedron of positive volume, counter-clockwise seen from outside."""
CREASE_RAD: Final = 0.6
"""Angle between triangles from which gmsh preserves the edge between them."""
MIN_QUALITY: Final = 0.01
"""Quality below which a tetrahedron spoils the solution: a regular one has 1."""


class Volume(NamedTuple):
    """Tetrahedra (m, 4) of vertices (n, 3) m, of positive volume."""

    vertices: Doubles
    tetrahedra: Whole


def fill(vertices: Doubles, triangles: Whole, resolution_m: float) -> Volume:
    """Fill a closed surface with tetrahedra of about this edge length; its triangles are replaced, too.

    Raises ValueError if gmsh is not installed, or cannot fill the surface.
    """
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    expected = abs(float(np.einsum("ij,ij->", a, np.cross(b, c)))) / 6.0 / (resolution_m**3 / 8.5)  # of regular ones
    if not expected <= limits.ELASTIC_TETRAHEDRA.high:
        size = " x ".join(f"{side:.3g}" for side in np.ptp(vertices, axis=0))
        raise ValueError(
            f"resolution_m = {resolution_m:g}: about {expected:,.0f} tetrahedra, at most "
            f"{int(limits.ELASTIC_TETRAHEDRA.high):,} can be solved: increase it, or change `scale` if the body is not "
            f"{size} m"
        )
    try:
        import gmsh
    except (ImportError, OSError) as missing:
        raise ValueError(f"gmsh is not usable ({missing}): pip install 'softfinger[elastic]'") from missing
    gmsh.initialize([], False, False, False)  # neither the user's settings nor a signal handler
    try:
        points, corners = _fill(gmsh, vertices, triangles, resolution_m)
    except Exception as error:  # gmsh raises no other class
        raise ValueError(f"gmsh cannot fill the surface: {error}: repair the mesh, or give a .msh file") from error
    finally:
        gmsh.finalize()
    return check_volume(points, corners)


def _fill(gmsh: Any, vertices: Doubles, triangles: Whole, resolution_m: float) -> tuple[Doubles, Whole]:
    gmsh.option.setNumber("General.Terminal", 0)
    for name in ("Mesh.MeshSizeMin", "Mesh.MeshSizeMax"):
        gmsh.option.setNumber(name, resolution_m)
    mesh = gmsh.model.mesh
    surface = gmsh.model.addDiscreteEntity(2)
    mesh.addNodes(2, surface, np.arange(1, len(vertices) + 1), vertices.ravel())
    mesh.addElementsByType(surface, 2, [], (triangles + 1).ravel())
    mesh.classifySurfaces(CREASE_RAD, True, True, np.pi)
    mesh.createGeometry()
    loop = gmsh.model.geo.addSurfaceLoop([tag for _, tag in gmsh.model.getEntities(2)])
    gmsh.model.geo.addVolume([loop])
    gmsh.model.geo.synchronize()
    mesh.generate(3)
    mesh.optimize("Netgen")  # without it, thin bodies have flat tetrahedra
    tags, points, _ = mesh.getNodes()
    _, corners = mesh.getElementsByType(4)
    place = np.zeros(int(tags.max()) + 1, np.int64)
    place[tags.astype(np.int64)] = np.arange(len(tags))
    return np.asarray(points).reshape(-1, 3), place[corners.astype(np.int64)].reshape(-1, 4)


def read_volume(file: str, scale: float) -> Volume:
    """Return the volume mesh of a .msh or .vtu file, m. Second-order tetrahedra are reduced to their corners.

    Raises ValueError if meshio is not installed, the file cannot be read, or its tetrahedra cannot be used.
    """
    try:
        import meshio
    except ImportError as missing:
        raise ValueError(f"meshio is not installed ({missing}): pip install 'softfinger[elastic]'") from missing
    if not Path(file).is_file():
        raise ValueError("no such file")
    try:
        with open(os.devnull, "w") as nothing, redirect_stdout(nothing), redirect_stderr(nothing):
            mesh = meshio.read(file)
    except SystemExit as error:  # meshio prints the reason
        raise ValueError("meshio cannot read it: it is damaged or has another format") from error
    except Exception as error:
        raise ValueError(f"meshio cannot read it: {error}") from error
    tetrahedra = [cells.data[:, :4] for cells in mesh.cells if cells.type in ("tetra", "tetra10")]
    if not tetrahedra:
        raise ValueError(f"has no tetrahedra, only {', '.join(mesh.cells_dict) or 'nothing'}: export the volume mesh")
    return check_volume(scale * np.asarray(mesh.points, np.float64), np.concatenate(tetrahedra).astype(np.int64))


def check_volume(vertices: Doubles, tetrahedra: Whole) -> Volume:
    """Return the volume without unused vertices. Raises ValueError for inverted, flat or too many tetrahedra."""
    most = int(limits.ELASTIC_TETRAHEDRA.high)
    if not 0 < len(tetrahedra) <= most:
        raise ValueError(f"{len(tetrahedra):,} tetrahedra: at most {most:,} can be solved: increase resolution_m")
    if not np.isfinite(vertices).all():
        raise ValueError("a coordinate is not finite")
    used, corners = np.unique(tetrahedra, return_inverse=True)
    volume = Volume(vertices[used], corners.reshape(-1, 4))
    measured = compute_quality(volume)
    worst = int(measured.argmin())
    if measured[worst] <= 0.0:
        raise ValueError(
            f"tetrahedron {worst} is inverted, with {int((measured <= 0.0).sum())} in all: repeat the meshing"
        )
    if measured[worst] < MIN_QUALITY:
        raise ValueError(f"tetrahedron {worst} is flat: quality {measured[worst]:.2g}, at least {MIN_QUALITY:g}")
    return volume


def compute_quality(volume: Volume) -> Doubles:
    """Return 6 sqrt(2) V / l^3 of each tetrahedron, l its root-mean-square edge: 1 if regular, below 0 if inverted."""
    a, b, c, d = (volume.vertices[volume.tetrahedra[:, i]] for i in range(4))
    six = np.einsum("ij,ij->i", b - a, np.cross(c - a, d - a))
    squares = sum(((p - q) ** 2).sum(axis=1) for p, q in ((a, b), (a, c), (a, d), (b, c), (b, d), (c, d)))
    qualities: Doubles = np.sqrt(2.0) * six / (np.asarray(squares) / 6.0) ** 1.5
    return qualities


def find_boundary(volume: Volume) -> Whole:
    """Return the triangles (k, 3) that belong to one tetrahedron, counter-clockwise seen from outside."""
    faces = volume.tetrahedra[:, FACES].reshape(-1, 3)
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    outer_faces: Whole = faces[first[count == 1]]
    return outer_faces
