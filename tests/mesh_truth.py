"""Check the rendering of a mesh by brute force: `python tests/mesh_truth.py [MESH ...] --points N --ticks N`.

Distances at random points, near to and far from the surface, are compared with a search of all triangles. Then a hand
presses, drags and lifts at random, with friction, torsion and rolling. In every tick the proxy's distance from all
triangles must be at least the radius of the fingertip, and the proxy must not have crossed a triangle since the
previous tick. `softfinger bench mesh` measures the time of a tick.

By default this is done for ten meshes made from formulas. The result is printed as JSON. Exit code 1 if an error was
found.
"""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any, Final

import numpy as np
from helpers import meshes
from helpers.surface_hand import hand
from helpers.touching import make_object, scene_with, write_part
from numpy.typing import NDArray
from references.brute_force import Balls, balls_of, brute_distances

from softfinger.config import schema
from softfinger.config.errors import HapticError
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.jit.pack import flatten, unpack
from softfinger.proxy.kernels.model import Triangles
from softfinger.proxy.kernels.shapes.budget import BUDGET
from softfinger.proxy.kernels.shapes.mesh.contact import NO_TRIANGLE
from softfinger.proxy.kernels.shapes.mesh.nearest import find_nearest
from softfinger.proxy.record import UNSEARCHED
from softfinger.proxy.scene import build_scene
from softfinger.server.progress import show_progress

Array = NDArray[np.float64]

MADE: Final = {
    "ball": lambda: meshes.geodesic(24, 0.05),
    "bumpy": lambda: meshes.bumpy_sphere(30, 0.05, height=0.06),
    "torus": lambda: meshes.torus(0.05, 0.02, 96, 48),
    "cylinder": lambda: meshes.cylinder(0.02, 0.1, 96, 1),
    "sheet": lambda: meshes.sheet(0.2, 0.1, 60, 40),
    "moebius": lambda: meshes.moebius(0.05, 0.03, 128, 6),
    "needles": lambda: meshes.cylinder(0.05, 1e-3, 20_000, 1),
    "crossing": lambda: meshes.joined(
        meshes.torus(0.05, 0.015, 64, 32), meshes.moved(meshes.geodesic(12, 0.03), (0.05, 0.0, 0.0))
    ),
    "far": lambda: meshes.moved(meshes.geodesic(12, 0.05), (300.0, -200.0, 100.0)),
    "two": lambda: meshes.joined(meshes.geodesic(8, 0.03), meshes.moved(meshes.geodesic(30, 0.03), (0.072, 0.0, 0.0))),
}
"""Ten meshes: smooth, bumpy, with sharp edges, open, one-sided, of needles, self-intersecting, far away, of two
parts."""
BLOCK: Final = 10_000
INSIDE: Final = 1e-9
"""Fraction of the radius that counts as inside, and of the mesh's size that counts as another distance."""
WHOLE: Final = 10**7
"""Budget that is never exhausted before the memory of a search."""


@entry
def ask(like: Any, values: Array, points: Array, budget: int, results: Array) -> None:
    """Fill `found` (n, 3): distance of each of `points` (n, 3), m, its lower bound, m, and the cost of the query."""
    mesh = unpack(like, values)
    for i in range(len(points)):
        near = find_nearest(mesh, (points[i, 0], points[i, 1], points[i, 2]), 1e300, NO_TRIANGLE, budget, 0.0)
        results[i, 0], results[i, 1], results[i, 2] = near.squared_distance**0.5, near.bound**0.5, near.visits


def triangles_of(scene: schema.Scene) -> meshes.Mesh:
    """Return the rendered triangles, after mending."""
    mesh: Triangles = build_scene(scene).objects.body.shape.row[0]
    return meshes.Mesh(mesh.vertices.array.reshape(-1, 3), mesh.corners.array.reshape(-1, 3))


def places(balls: Balls, count: int, rng: np.random.Generator) -> Array:
    """Return points (count, 3), m: most near the surface, including vertices and edges, some far away."""
    corners = balls.corners[rng.integers(len(balls.corners), size=count)]
    weights = rng.dirichlet(np.ones(3), size=count)
    weights[::7] = (0.5, 0.5, 0.0)
    weights[::11] = (1.0, 0.0, 0.0)
    on = np.einsum("ij,ijk->ik", weights, corners)
    size = np.ptp(balls.corners.reshape(-1, 3), axis=0).max()
    away = size * 10.0 ** rng.uniform(-8.0, 1.0, (count, 1))
    away[::13] = 0.0
    return on + away * rng.normal(size=(count, 3))


def check_distances(scene: schema.Scene, balls: Balls, count: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return the largest error relative to the mesh's size, for searches that finish: their memory is limited, and
    thousands of needles that meet in a vertex are equally close.

    The same with the budget of a tick; and by how much the bound of an unfinished search exceeds the distance.
    """
    mesh = build_scene(scene).objects.body.shape
    size = float(mesh.row[0].size)
    worst = dict.fromkeys(("points", "unended", "budget"), 0)
    worst |= dict.fromkeys(("error", "error_in_budget", "bound_above", "asked_max"), 0.0)
    with show_progress("distances", count) as show:
        for begun in range(0, count, BLOCK):
            points = places(balls, min(BLOCK, count - begun), rng)
            whole, short = np.zeros((2, len(points), 3))
            ask(mesh, flatten(mesh), points, WHOLE, whole)
            ask(mesh, flatten(mesh), points, BUDGET, short)
            true = brute_distances(balls, points)
            worst["points"] += len(points)
            worst["asked_max"] = max(worst["asked_max"], float(whole[:, 2].max()))
            for results, error, beyond in ((whole, "error", "unended"), (short, "error_in_budget", "budget")):
                spent = results[:, 1] < results[:, 0]
                worst[beyond] += int(spent.sum())
                worst["bound_above"] = max(worst["bound_above"], float((results[:, 1] - true).max() / size))
                off = np.abs(results[:, 0] - true)[~spent]
                worst[error] = max(worst[error], float(off.max(initial=0.0) / size))
            show(begun + len(points))
    return worst


def goes_through(balls: Balls, begun: Array, ended: Array, radius: float) -> bool:
    """Return whether a path (3,), m, crosses a triangle or nearly does, sampled every quarter of a radius."""
    looks = np.linspace(0.0, 1.0, 2 + int(4.0 * np.linalg.norm(ended - begun) / radius))[:, None]
    return bool(brute_distances(balls, begun + looks * (ended - begun)).min() <= 0.125 * radius)


def check_ticks(scene: schema.Scene, balls: Balls, poses: Array, radius: float) -> dict[str, Any]:
    """Return the number of each kind of error in these ticks, and the deepest position of the proxy."""
    running, last = Engine(scene), poses[0, :3]
    counts = {"ticks": 0, "touching": 0, "budget": 0, "not_finite": 0, "inside": 0, "through": 0}
    deepest = 0.0
    with show_progress("ticks", len(poses)) as show:
        for begun in range(0, len(poses), BLOCK):
            records = running.run(poses[begun : begun + BLOCK])
            proxies = records["proxy.position"]
            wrong = ~np.isfinite(np.asarray(records)).all(axis=1)
            inside = 1.0 - brute_distances(balls, proxies) / radius
            starts = np.vstack([last[None], proxies[:-1]])
            # Two positions outside that are less than two radii apart cannot have a triangle in between.
            far = np.flatnonzero(np.linalg.norm(proxies - starts, axis=1) >= 2.0 * radius)
            counts["ticks"] += len(records)
            counts["touching"] += int((records["contact.mode"] > 0).sum())
            counts["budget"] += int((records["contact.budget"] == UNSEARCHED).sum())
            counts["not_finite"] += int(wrong.sum())
            counts["inside"] += int((inside > INSIDE).sum())
            counts["through"] += sum(goes_through(balls, starts[i], proxies[i], radius) for i in far)
            deepest, last = max(deepest, float(inside.max())), np.array(proxies[-1])
            show(begun + len(records))
    return counts | {"deepest": deepest}


def judge(file: str, args: argparse.Namespace, rng: np.random.Generator) -> dict[str, Any]:
    part = make_object("part", "mesh", file=file, scale=args.scale)
    scene = scene_with(part, fingertip={"radius_m": args.radius})
    mesh = triangles_of(scene)
    balls = balls_of(*mesh)
    result: dict[str, Any] = {"triangles": len(mesh.triangles)}
    if args.points:
        result["distances"] = check_distances(scene, balls, args.points, rng)
    if args.ticks:
        result["hand"] = check_ticks(scene, balls, hand(mesh, args.ticks, args.radius, rng), args.radius)
    return result


def is_wrong(result: dict[str, Any]) -> bool:
    away, ticks = result.get("distances"), result.get("hand")
    off = away is not None and max(away["error"], away["error_in_budget"], away["bound_above"]) > INSIDE
    return off or (ticks is not None and ticks["inside"] + ticks["not_finite"] + ticks["through"] > 0)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("mesh", nargs="*", help=f"a file, or one of {', '.join(MADE)} (default: all of these)")
    parser.add_argument("--points", type=int, default=100_000, help="on each mesh (default: %(default)s; 0 for none)")
    parser.add_argument("--ticks", type=int, default=100_000, help="on each mesh (default: %(default)s; 0 for none)")
    parser.add_argument("--radius", type=float, default=0.01, help="of the fingertip, m (default: %(default)s)")
    parser.add_argument("--scale", type=float, default=1.0, help="of the files, to metres (default: %(default)s)")
    args, result = parser.parse_args(), {}
    try:
        with tempfile.TemporaryDirectory() as folder:
            for name in args.mesh or MADE:
                file = write_part(Path(folder), *MADE[name](), name=f"{name}.ply") if name in MADE else name
                result[Path(file).stem] = judge(file, args, np.random.default_rng(0))
    except HapticError as error:
        print(f"error: {error}", file=sys.stderr)
        return error.exit_code
    print(json.dumps(result, indent=2))
    return int(any(is_wrong(content) for content in result.values()))


if __name__ == "__main__":
    sys.exit(main())
