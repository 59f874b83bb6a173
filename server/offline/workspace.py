"""Front and right view of a workspace, as text or figure.

A view shows the soft wall of a rig, the arc or plane of a device with one or two degrees of freedom, and the objects of
a scene.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from softfinger.config.arrays import Array
from softfinger.config.schema import Object, Plane, Scene, Workspace
from softfinger.drivers.kinematics.subspace import MotionSubspace
from softfinger.proxy.pictures import Filed, make_picture
from softfinger.proxy.rotation import make_matrix
from softfinger.server.offline.figures import make_figure, save
from softfinger.server.surface_meshes import make_plane, make_surface

VIEWS: Final = (("from the front", 0, "x"), ("from the right", 1, "y"))
"""Name of each view, and index and name of the axis that points right; z points up."""
COLUMNS: Final = 49
ROWS: Final = 25
"""Cells of a view: odd numbers, so that one is in the centre; a character is twice as high as wide."""
VIEW_SCALE: Final = 1.25
"""Size of the drawn area, as a multiple of the workspace."""
NUMBERS: Final = "123456789abcdefghijklmnopqrstuvwxyz"
WALL_MARK: Final = "·"
CURVE_MARK: Final = "="
DIRECTIONS: Final = 720
"""Number of directions in which the edge of a plane inside the wall is searched, or of points tested on an arc."""


class PlacedObject(NamedTuple):
    """Object: name, corners (n, 3, 3) of its triangles, m in the world, and points (m, 3) on them."""

    name: str
    triangles: Array
    points: Array


def compute_half_sizes(wall: Workspace) -> Array:
    """Return half the size (3,) m of the bounding box of the workspace."""
    return np.full(3, wall.radius_m) if wall.size_m is None else 0.5 * np.array(wall.size_m)


def compute_signed_distance(wall: Workspace, points: Array) -> Array:
    """Return the distance (n,) m of points (n, 3) beyond the wall, negative inside."""
    offsets = points - np.array(wall.center_m)
    if wall.size_m is None:
        assert wall.radius_m is not None
        return np.asarray(np.linalg.norm(offsets, axis=1) - wall.radius_m)
    excess = np.abs(offsets) - compute_half_sizes(wall)
    return np.asarray(np.linalg.norm(np.maximum(excess, 0.0), axis=1) + np.minimum(excess.max(axis=1), 0.0))


def place_objects(wall: Workspace, scene: Scene) -> list[PlacedObject]:
    """Return the objects of a scene at their initial poses, without shapes that have no picture here."""
    cell = 2.0 * VIEW_SCALE * float(compute_half_sizes(wall).max()) / COLUMNS
    placed_objects = []
    for obj in scene.object:
        corners = _compute_corners(
            obj, 8.0 * float(compute_half_sizes(wall).max()) + 2.0 * float(np.abs(wall.center_m).max())
        )
        if corners is not None:
            corners_w = corners @ np.array(make_matrix(obj.orientation_wxyz)).T + np.array(obj.position_m)
            placed_objects.append(PlacedObject(obj.name, corners_w, _sample_triangles(corners_w, 0.5 * cell)))
    return placed_objects


def make_rows(wall: Workspace, objects: list[PlacedObject]) -> list[tuple[str, str]]:
    """Return for each object whether the fingertip's centre can reach it inside the wall."""
    reach_rows = []
    for number, obj in zip(NUMBERS, objects, strict=False):
        distances = 1e3 * compute_signed_distance(wall, obj.points)
        if distances.max() <= 0.0:
            reach = "inside"
        elif distances.min() > 0.0:
            reach = f"outside: its nearest point is {distances.min():.0f} mm behind the wall"
        else:
            reach = "inside and outside"
        reach_rows.append((f"{number} '{obj.name}'", reach))
    return reach_rows


def compute_reachable_curve(wall: Workspace, freedom: MotionSubspace) -> Array:
    """Return points (n, 3) m inside the wall, on the arc of a device or on the edge of its plane."""
    angles = np.linspace(-np.pi, np.pi, DIRECTIONS)[:, None]
    normal, half = freedom.axis, float(compute_half_sizes(wall).max())
    if freedom.degrees == 1:
        arm = freedom.centre - freedom.origin
        points = freedom.origin + np.cos(angles) * arm + np.sin(angles) * np.cross(normal, arm)
        return np.asarray(points[compute_signed_distance(wall, points) <= 0.0])
    centre = np.array(wall.center_m)
    centre = centre - (centre - freedom.origin) @ normal * normal
    tangent = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    tangent /= np.linalg.norm(tangent)
    rays = np.cos(angles) * tangent + np.sin(angles) * np.cross(normal, tangent)
    reach = np.linspace(0.0, 2.0 * half, DIRECTIONS)
    points = centre + reach[None, :, None] * rays[:, None, :]
    inside = compute_signed_distance(wall, points.reshape(-1, 3)).reshape(points.shape[:2]) <= 0.0
    if not inside[0, 0]:  # the plane does not intersect the workspace
        return np.zeros((0, 3))
    return np.asarray(points[np.arange(DIRECTIONS), inside.sum(axis=1) - 1])


def draw_text(wall: Workspace, objects: list[PlacedObject], freedom: MotionSubspace | None = None) -> list[str]:
    views = [_view(wall, objects, axis, freedom) for _, axis, _ in VIEWS]
    half = 1e3 * VIEW_SCALE * float(compute_half_sizes(wall).max())
    heads = [f"{name}: {letter} to the right, z up; {2 * half:.0f} mm wide" for name, _, letter in VIEWS]
    lines = ["   ".join(head.ljust(COLUMNS) for head in heads).rstrip()]
    lines += ["   ".join(pair).rstrip() for pair in zip(*views, strict=True)]
    lines.append(f"{WALL_MARK} inside of the wall, + its centre, numbers: objects")
    if freedom is not None:
        curve = "the arc" if freedom.degrees == 1 else "the edge of the plane"
        lines.append(f"{CURVE_MARK} {curve} in which the handle moves; other forces are not displayed")
    return lines


def plot(wall: Workspace, objects: list[PlacedObject], path: Path, freedom: MotionSubspace | None = None) -> None:
    """Draw both views as a figure, .png or .svg, axes in mm."""
    from matplotlib.collections import PolyCollection

    drawing = make_figure(9.0, 4.8)
    half = 1e3 * VIEW_SCALE * float(compute_half_sizes(wall).max())
    for axes, (name, axis, letter) in zip(drawing.subplots(1, 2), VIEWS, strict=True):
        middle = 1e3 * np.array([wall.center_m[axis], wall.center_m[2]])
        for number, obj in enumerate(objects):
            flat = 1e3 * obj.triangles[:, :, [axis, 2]]
            colour = f"C{number}"
            axes.add_collection(
                PolyCollection(list(flat), facecolor=colour, edgecolor=colour, alpha=0.4, linewidth=0.6)
            )
            axes.plot([], [], color=colour, label=obj.name)
        u, v = np.meshgrid(*(np.linspace(m - half, m + half, 201) for m in middle))
        distances = compute_signed_distance(
            wall, 1e-3 * _project_points(1e3 * np.array(wall.center_m), axis, u, v)
        ).reshape(u.shape)
        axes.contour(u, v, distances, [0.0], colors="black", linestyles="dashed")
        if freedom is not None:
            line = 1e3 * compute_reachable_curve(wall, freedom)
            axes.plot(line[:, axis], line[:, 2], "r-", linewidth=1.5)
        axes.set(xlim=middle[0] + [-half, half], ylim=middle[1] + [-half, half], aspect="equal", title=name)
        axes.set(xlabel=f"{letter} [mm]", ylabel="z [mm]")
    axes.plot([], [], "k--", label="soft wall")
    if freedom is not None:
        axes.plot([], [], "r-", label="the handle's arc" if freedom.degrees == 1 else "edge of the handle's plane")
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize="small")
    save(drawing, path)


def _view(wall: Workspace, objects: list[PlacedObject], axis: int, freedom: MotionSubspace | None) -> list[str]:
    """Return a view as ROWS lines of COLUMNS characters."""
    center, half = np.array(wall.center_m), VIEW_SCALE * float(compute_half_sizes(wall).max())
    right, up = np.meshgrid(np.linspace(-half, half, COLUMNS), np.linspace(half, -half, ROWS))
    inside = (
        compute_signed_distance(wall, _project_points(center, axis, center[axis] + right, center[2] + up)).reshape(
            right.shape
        )
        <= 0.0
    )
    cells = np.where(inside, WALL_MARK, " ")
    marks = [(number, obj.points) for number, obj in zip(NUMBERS, objects, strict=False)]
    if freedom is not None:
        marks.append((CURVE_MARK, compute_reachable_curve(wall, freedom)))
    for mark, points in marks:
        column = np.rint((points[:, axis] - center[axis] + half) / (2.0 * half) * (COLUMNS - 1))
        row = np.rint((half - points[:, 2] + center[2]) / (2.0 * half) * (ROWS - 1))
        is_visible = (column >= 0) & (column < COLUMNS) & (row >= 0) & (row < ROWS)
        cells[row[is_visible].astype(int), column[is_visible].astype(int)] = mark
    cells[ROWS // 2, COLUMNS // 2] = "+"
    return ["".join(line) for line in cells]


def _project_points(center: Array, axis: int, right: Array, up: Array) -> Array:
    """Return points (n, 3) in a view's plane through the centre."""
    points = np.tile(center, (right.size, 1))
    points[:, axis], points[:, 2] = right.ravel(), up.ravel()
    return points


def _compute_corners(obj: Object, edge: float) -> Array | None:
    """Return the corners (n, 3, 3) of an object's triangles, m, in its frame; for a plane a square of edge `edge` m."""
    if isinstance(obj, Filed):
        (vertices, faces), _ = make_picture(obj)
        corners: Array = np.asarray(vertices, float)[np.asarray(faces, int)]
        return corners
    mesh = make_plane(edge) if isinstance(obj, Plane) else make_surface(obj)
    return None if mesh is None else np.asarray(mesh.vertices[mesh.faces])


def _sample_triangles(triangles: Array, step: float) -> Array:
    """Return points (n, 3) on triangles, at most `step` m apart unless that takes more than 400 per edge."""
    points = []
    for triangle in triangles:
        longest = max(float(np.linalg.norm(triangle[k] - triangle[k - 1])) for k in range(3))
        n = int(np.clip(np.ceil(longest / step), 1, 400))
        i, j = (index.ravel() for index in np.meshgrid(np.arange(n + 1), np.arange(n + 1)))
        is_in_triangle = i + j <= n
        shares = np.stack([i, j, n - i - j])[:, is_in_triangle].T / n
        points.append(shares @ triangle)
    return np.concatenate(points) if points else np.zeros((0, 3))
