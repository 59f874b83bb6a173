"""`accuracy --meshes`: convergence of meshes of a ball, a cylinder and a torus to the surfaces, by edge length.

A fingertip is pressed in by a millimetre and moved along paths on which it would roll on the surface, oblique to many
edges. Along these paths the contact point and the normal of the surface are known, and so are force and roll. Without
friction, the force and the contact point of the mesh are compared with them. With sticking friction and rolling, the
rolled angle is compared, and the extension of the friction spring for a hand that moves exactly as the fingertip rolls.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterator, Sequence
from itertools import product
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.config.load import build
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.shapes import closest
from softfinger.proxy.records import Records
from softfinger.server.offline.figures import make_figure, save
from softfinger.server.progress import show_progress
from softfinger.tools.accuracy.reference import roll_path
from softfinger.tools.measure import Array, show_and_draw

Arrays = tuple[Array, NDArray[np.int64]]

RADIUS_M: Final = 0.01
DEPTH_M: Final = 0.001
STIFFNESS: Final = 1000.0
TURN_RAD: Final = 2.0
TICKS: Final = 2000
HEADINGS_RAD: Final = tuple(np.radians((20.0, 45.0, 70.0)))
"""Directions of the first steps of the paths, from the parallel around the z axis.

One path crosses too few edges of a coarse mesh for a slope, and a path along edges crosses none. Therefore the largest
difference of three paths counts.
"""
DESCENT_TICKS: Final = 300
"""Ticks in which the fingertip descends, before the ones that count."""
FINENESS: Final = (8, 16, 32, 64)
FITTED_MESHES: Final = 3
"""Number of the finest meshes to which the orders are fitted."""
MEASURES: Final = {
    "force_n": "force",
    "point_m": "contact point off the surface",
    "rolled_m": "angle rolled x radius",
    "wound_m": "rolled distance, and the distance that was led",
    "direction_rad": "direction",
    "shaded_rad": "direction, shaded",
}


class MeshCase(NamedTuple):
    """Surface: kernel shape, function from fineness to triangles, and point (3,) m near the start of a path."""

    shape: Any
    triangles: Callable[[int], Arrays]
    near: model.Vec3


class LedPath(NamedTuple):
    """Path of the fingertip, and the contact of the surface along it.

    poses    (DESCENT_TICKS + n, 7)  m    descent onto the surface, then motion along it
    points   (n, 3)            m    contact points
    normals  (n, 3)                 normals at the contact points
    rolled   (n,)              rad  angle, summed over ticks
    """

    poses: Array
    points: Array
    normals: Array
    rolled: Array


def triangulate_cells(at: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return two triangles for each cell of a grid of vertex indices, wound from the rows towards the columns."""
    a, b, c, d = (part.ravel() for part in (at[:-1, :-1], at[1:, :-1], at[1:, 1:], at[:-1, 1:]))
    return np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def triangulate_grid(points: Array, rows_meet: bool = False, columns_meet: bool = False) -> Arrays:
    """Return the triangles of a grid of points (n, m, 3) m; the last row or column may connect to the first."""
    at = np.arange(points[..., 0].size).reshape(points.shape[:2])
    return points.reshape(-1, 3), triangulate_cells(np.pad(at, ((0, rows_meet), (0, columns_meet)), mode="wrap"))


def make_ring(major: float, minor: float, along: int, around: int) -> Arrays:
    u, v = (2.0 * np.pi * np.arange(count)[:, None] / count for count in (along, around))
    out, up = major + minor * np.cos(v.T), minor * np.sin(v.T)
    return triangulate_grid(np.stack([np.cos(u) * out, np.sin(u) * out, 0.0 * u + up], axis=2), True, True)


def make_tube(radius: float, length: float, around: int, along: int) -> Arrays:
    """Return a tube about the z axis that is open at its ends."""
    u, z = 2.0 * np.pi * np.arange(around) / around, np.linspace(-0.5, 0.5, along + 1)[:, None] * length
    points = np.stack(np.broadcast_arrays(radius * np.cos(u), radius * np.sin(u), z), axis=2)
    vertices, triangles = triangulate_grid(points, columns_meet=True)
    return vertices, triangles[:, ::-1]


def make_geodesic(corners: Array, faces: Sequence[Sequence[int]], fineness: int) -> Arrays:
    """Return a polyhedron with each face divided into fineness^2 triangles, projected onto the unit sphere."""
    i, j = (axis.ravel() for axis in np.indices((fineness + 1, fineness + 1)))
    keep = i + j <= fineness
    at = np.full((fineness + 1, fineness + 1), -1)
    at[i[keep], j[keep]] = np.arange(keep.sum())
    up, down = i + j < fineness, (i > 0) & (j > 0) & keep
    divided = np.concatenate([
        np.stack([at[i[up], j[up]], at[i[up] + 1, j[up]], at[i[up], j[up] + 1]], axis=1),
        np.stack([at[i[down], j[down]], at[i[down] - 1, j[down]], at[i[down], j[down] - 1]], axis=1),
    ])  # fmt: skip
    weights = np.stack([i, j, fineness - i - j], axis=1)[keep]
    points = np.concatenate([weights @ corners[list(face)] for face in faces])
    triangles = np.concatenate([divided + k * len(weights) for k in range(len(faces))])
    # Faces share the points of their edges, to rounding.
    _, first, places = np.unique(points.round(9), axis=0, return_index=True, return_inverse=True)
    return points[first] / np.linalg.norm(points[first], axis=1)[:, None], places.ravel()[triangles]


def make_ball(radius: float, fineness: int) -> Arrays:
    """Return an octahedron with divided faces, projected onto a sphere: 8 x fineness^2 triangles."""
    octants = product((0, 3), (1, 4), (2, 5))
    outward = [(x, y, z) if (x + y + z) % 2 else (y, x, z) for x, y, z in octants]
    points, triangles = make_geodesic(np.vstack([np.eye(3), -np.eye(3)]), outward, fineness)
    return radius * points, triangles


CASES: Final = {
    "ball": MeshCase(model.Sphere(0.05, 1.0), lambda n: make_ball(0.05, 2 * n), (0.04, 0.02, 0.03)),
    "cylinder": MeshCase(model.Cylinder(0.03, 1.0), lambda n: make_tube(0.03, 0.2, 8 * n, 4 * n), (0.04, 0.02, 0.003)),
    "torus": MeshCase(model.Torus(0.05, 0.02, 1.0), lambda n: make_ring(0.05, 0.02, 6 * n, 3 * n), (0.06, 0.03, 0.01)),
}


def run(args: argparse.Namespace) -> int:
    rows: list[dict[str, Any]] = []
    with show_progress("meshes of surfaces", len(CASES) * len(FINENESS)) as update:
        for name in CASES:
            for row in converge(name, FINENESS):
                rows.append(row)
                update(len(rows))
    result = {"rows": rows, "orders": {name: fit_orders([r for r in rows if r["surface"] == name]) for name in CASES}}
    return show_and_draw(args, result, format_lines(result), lambda path: draw(result, path))


def converge(name: str, fineness: Sequence[int], ticks: int = TICKS) -> Iterator[dict[str, Any]]:
    """Yield a row for each fineness: the largest differences from the surface on all paths.

    A row also has the largest change of the force's direction from tick to tick, rad, which is N per N.
    """
    case = CASES[name]
    paths = [make_lead_path(case.shape, *find_start(case), heading, ticks) for heading in HEADINGS_RAD]
    for n in fineness:
        vertices, triangles = case.triangles(n)
        edges = vertices[triangles] - vertices[np.roll(triangles, 1, axis=1)]
        with tempfile.TemporaryDirectory() as folder:
            table = {"shape": "mesh", "file": save_mesh(Path(folder), vertices, triangles)}
            flat, rolls = (Engine(make_scene(table, sticks)) for sticks in (False, True))
            shaded = Engine(make_scene(table | {"shading": "normals"}, False))
        rows = [
            find_differences(path, *(visit(rendered, path) for rendered in (flat, shaded, rolls))) for path in paths
        ]
        yield {
            "surface": name,
            "triangles": len(triangles),
            "edge_m": float(np.linalg.norm(edges, axis=2).max()),
            **{key: max(row[key] for row in rows) for key in rows[0]},
        }


def visit(engine: Engine, path: LedPath) -> Records:
    """Return the records (n,) of a path after the descent, from a reset engine."""
    engine.reset()
    records: Records = engine.run(path.poses)[DESCENT_TICKS:]
    return records


def find_differences(path: LedPath, flat: Records, shaded: Records, rolls: Records) -> dict[str, float]:
    """Return the largest differences of a mesh from its surface on a path.

    flat, shaded  records without friction
    rolls         records with friction
    """
    distances = np.einsum("ij,ij->i", flat["contact.point"] - path.points, path.normals)
    return {
        "force_n": find_largest(flat["contact.normal_force"] - STIFFNESS * DEPTH_M),
        "point_m": find_largest(distances),
        "rolled_m": RADIUS_M * find_largest(rolls["contact.rolled"] - path.rolled),
        "wound_m": find_largest(rolls["contact.tangential_force"]) / STIFFNESS,
        "direction_rad": find_largest(compute_directions(flat) - path.normals),
        "shaded_rad": find_largest(compute_directions(shaded) - path.normals),
        "step_rad": find_largest(np.diff(compute_directions(flat), axis=0)),
        "shaded_step_rad": find_largest(np.diff(compute_directions(shaded), axis=0)),
    }


def find_start(case: MeshCase) -> tuple[Array, Array]:
    """Return the point (3,) m of the surface where a path starts, and its normal (3,)."""
    _, foot, up = closest(case.shape, case.near)
    return np.array(foot), np.array(up)


def make_lead_path(shape: Any, foot: Array, normal: Array, heading: float, ticks: int) -> LedPath:
    """Return the descent onto a point and the path on which the fingertip rolls from there.

    foot     (3,)  m, point of the surface
    normal   (3,)  normal there
    heading  rad   initial direction
    """
    east = np.cross((0.0, 0.0, 1.0), normal)
    east /= np.linalg.norm(east)
    axis = np.cos(heading) * np.cross(normal, east) - np.sin(heading) * east
    t = np.linspace(0.0, 1.0, ticks)
    start = foot + RADIUS_M * normal
    points, normals, _ = roll_path(shape, RADIUS_M, start, normal, lambda _: TURN_RAD * axis).at(t)
    down = np.minimum(np.arange(DESCENT_TICKS) / (0.7 * DESCENT_TICKS), 1.0)[:, None]
    heights = RADIUS_M + 0.1 * DEPTH_M - 1.1 * DEPTH_M * down
    places = np.concatenate([points[0] + heights * normals[0], points + (RADIUS_M - DEPTH_M) * normals])
    half = 0.5 * TURN_RAD * np.concatenate([np.zeros(DESCENT_TICKS), t])[:, None]
    # A tick rolls in the tangent plane at its end.
    steps = TURN_RAD * np.diff(t, prepend=0.0) * np.linalg.norm(np.cross(axis, normals), axis=1)
    return LedPath(np.hstack([places, np.cos(half), np.sin(half) * axis]), points, normals, np.cumsum(steps))


def make_scene(table: dict[str, Any], sticks: bool) -> schema.Scene:
    material: dict[str, Any] = {"stiffness_n_per_m": STIFFNESS}
    tables: dict[str, Any] = {
        "fingertip": {"radius_m": RADIUS_M},
        "coupling": {"stiffness_n_per_m": STIFFNESS, "damping_ns_per_m": 0.0},
        "object": [{"name": "surface", "material": material, **table}],
    }
    if sticks:
        material["friction"] = {"static": 5.0, "kinetic": 4.0}
        tables["rolling"] = {"method": "midpoint"}
    return build(schema.Scene, tables, "accuracy --meshes")


def save_mesh(folder: Path, vertices: Array, triangles: NDArray[np.int64]) -> str:
    """Write an OBJ file with all digits of the numbers, and return its path."""
    path = folder / "surface.obj"
    rows = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.tolist()]
    path.write_text("\n".join([*rows, *(f"f {a} {b} {c}" for a, b, c in (triangles + 1).tolist())]) + "\n")
    return str(path)


def compute_directions(records: Records) -> Array:
    """Return the unit vectors (n, 3) of the forces."""
    forces: Array = records["force"]
    return np.asarray(forces / np.linalg.norm(forces, axis=1)[:, None])


def find_largest(values: Array) -> float:
    return float((np.linalg.norm(values, axis=1) if values.ndim > 1 else np.abs(values)).max())


def fit_orders(rows: Sequence[dict[str, Any]]) -> dict[str, float]:
    """Return the slopes of the errors against the edge length, in logarithms, of the finest meshes."""
    edges = np.log([row["edge_m"] for row in rows[-FITTED_MESHES:]])
    return {
        key: float(np.polyfit(edges, np.log([row[key] for row in rows[-FITTED_MESHES:]]), 1)[0]) for key in MEASURES
    }


def format_lines(result: dict[str, Any]) -> Iterator[str]:
    yield "largest differences of a mesh from its surface; the slope over the edge's length of the finest three"
    for row in result["rows"]:
        errors = "  ".join(f"{key} {row[key]:.1e}" for key in (*MEASURES, "step_rad", "shaded_step_rad"))
        yield f"{row['surface']:9} edge {1e3 * row['edge_m']:6.3f} mm  {errors}"
    for name, orders in result["orders"].items():
        yield f"{name:9} " + "  ".join(f"{key} {order:.2f}" for key, order in orders.items())


def draw(result: dict[str, Any], file: Path) -> None:
    """Draw a panel for each surface: errors against edge length, with a line of second order."""
    drawing = make_figure(10.0, 4.0)
    for axes, name in zip(drawing.subplots(1, len(CASES), sharex=True), CASES, strict=True):
        rows = [row for row in result["rows"] if row["surface"] == name]
        edges = np.array([1e3 * row["edge_m"] for row in rows])
        for key, text in MEASURES.items():
            axes.loglog(edges, [row[key] for row in rows], "o-", label=f"{text} ({result['orders'][name][key]:.1f})")
        axes.loglog(edges, 1e-6 * edges**2, "k:", label="second order")
        axes.set(title=name, xlabel="longest edge, mm")
        axes.legend(fontsize="x-small")
    save(drawing, file)
