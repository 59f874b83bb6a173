"""Generator of the meshes and solutions of the shipped scenes with an elastic object.

    python -m softfinger.tools.elastic_scenes OUTDIR    # the meshes
    python -m softfinger.tools.elastic_scenes SCENE     # solves the body of a scene, and writes the file `solution`

The second form works for any scene with an elastic object. It needs the extra `elastic`.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import ConfigError
from softfinger.config.load import load_scene
from softfinger.config.schema import Mesh
from softfinger.proxy import progress as preparation
from softfinger.proxy.elastic import prepared, solution
from softfinger.proxy.meshes.reading import read_bytes
from softfinger.server.progress import show_progress

Points = NDArray[np.float64]
Faces = NDArray[np.int64]

BALL_M: Final = 0.02
BALL_DIVISIONS: Final = 3
"""Times that the triangles of an icosahedron are divided: a chord is then 0.05 mm from the sphere."""


def make_box(low: Sequence[float], high: Sequence[float]) -> tuple[Points, Faces]:
    """Return vertices, m, and triangles of a box along the axes."""
    corners = np.array([(x, y, z) for x in (low[0], high[0]) for y in (low[1], high[1]) for z in (low[2], high[2])])
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    return corners, np.array([triangle for a, b, c, d in faces for triangle in ((a, b, c), (a, c, d))])


def make_ball(radius: float) -> tuple[Points, Faces]:
    """Return vertices, m, and triangles of a sphere about the origin."""
    golden = 0.5 * (1.0 + 5.0**0.5)
    corners = [(-1, golden, 0), (1, golden, 0), (-1, -golden, 0), (1, -golden, 0)]
    points = np.array([np.roll(corner, turn) for turn in range(3) for corner in corners], np.float64)
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    near = ((points[:, None] - points[None]) ** 2).sum(axis=2) < 1.2
    triples = np.argwhere(near[:, :, None] & near[None, :, :] & near[:, None, :])
    faces = triples[(np.diff(triples, axis=1) > 0).all(axis=1)]
    inward = np.einsum("ij,ij->i", points[faces[:, 0]], np.cross(points[faces[:, 1]], points[faces[:, 2]])) < 0.0
    faces[inward] = faces[inward][:, ::-1]
    for _ in range(BALL_DIVISIONS):
        points, faces = _subdivide(points, faces)
    return radius * points, faces


def _subdivide(points: Points, faces: Faces) -> tuple[Points, Faces]:
    """Return a unit sphere with four triangles for each."""
    edges = np.sort(faces[:, ((0, 1), (1, 2), (2, 0))].reshape(-1, 2), axis=1)
    unique, place = np.unique(edges, axis=0, return_inverse=True)
    middle = points[unique].sum(axis=1)
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    (a, b, c), (ab, bc, ca) = faces.T, len(points) + place.reshape(-1, 3).T
    parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
    return np.concatenate([points, middle]), np.concatenate([np.stack(part, axis=1) for part in parts])


MESHES: Final = {
    "press-a-pad": make_box((-0.03, -0.03, 0.0), (0.03, 0.03, 0.02)),
    "bend-a-strip": make_box((-0.1, -0.01, -0.003), (0.01, 0.01, 0.0)),
    "squeeze-a-ball": make_ball(BALL_M),
}
"""Vertices and triangles for each shipped scene."""


def write_meshes(folder: Path) -> list[Path]:
    """Write the meshes as .obj files, the same bytes on every machine, and return their paths."""
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for name, (points, faces) in MESHES.items():
        lines = ["v {:.7g} {:.7g} {:.7g}".format(*(point + 0.0)) for point in points.round(9)]
        lines += ["f {} {} {}".format(*face) for face in faces + 1]
        paths.append(folder / f"{name}.obj")
        paths[-1].write_text("\n".join(lines) + "\n", "utf-8")
    return paths


def write_solution(scene: Any) -> str:
    """Solve the elastic body of a scene, write it to its file `solution`, and return the path.

    Raises ConfigError if the scene has no such body or file, or the body cannot be solved.
    """
    (obj,) = load_scene(scene).object[:1]
    elastic = obj.elastic if isinstance(obj, Mesh) else None
    if not isinstance(obj, Mesh) or elastic is None or elastic.solution is None:
        raise ConfigError(f"{scene}: has no object.elastic.solution, the file to be written")
    preparation.display = show_progress
    try:
        body = prepared.solve(obj, elastic)
    except ValueError as error:
        raise ConfigError(f"object '{obj.name}': elastic: {obj.file}: {error}") from error
    solution.save(elastic.solution, solution.make_identity(obj, elastic, read_bytes(obj.file)), body)
    return elastic.solution


def main() -> None:
    parser = argparse.ArgumentParser(description="Write the meshes of the shipped elastic scenes, or solve a scene.")
    parser.add_argument("what", help="folder for the meshes; or a scene: a .toml file, or the name of a shipped one")
    scene_name = parser.parse_args().what
    if Path(scene_name).suffix == ".toml" or scene_name in MESHES:
        print(write_solution(scene_name))
    else:
        print(*write_meshes(Path(scene_name)), sep="\n")


if __name__ == "__main__":
    main()
