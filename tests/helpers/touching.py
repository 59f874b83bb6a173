"""A mesh in a scene with friction, torsion and rolling, and hands that move over it."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from helpers.meshes import Mesh, write_ply
from softfinger.config.load import build
from softfinger.config.schema import Scene
from softfinger.proxy.engine import Engine
from softfinger.proxy.record import CAUSE_NAMES

Array = NDArray[np.float64]

R = 0.01
"""Radius of the fingertip, m."""
FRICTION = {"static": 0.6, "kinetic": 0.5}
TORSION = {"stiffness_nm_per_rad": 0.05, "friction_length_m": 0.004}
GRIP: dict[str, Any] = {"stiffness_n_per_m": 1000.0, "friction": FRICTION, "torsion": TORSION}
SMOOTH = {"friction": None, "torsion": None}
"""Material without friction, which has its own compiled code."""
SLIPPERY = {"friction": {"static": 0.0, "kinetic": 0.0}}
"""Material with a friction coefficient of zero: compiled code with friction, with other numbers."""


def write_part(folder: Path, vertices: ArrayLike, triangles: ArrayLike, name: str = "part.ply") -> str:
    """Write a binary PLY of `vertices` (n, 3) m and `triangles` (m, 3); return its path."""
    mesh = Mesh(np.asarray(vertices, float), np.asarray(triangles))
    return str(write_ply(folder / name, mesh, "double"))


def make_object(name: str, shape: str, **keys: Any) -> dict[str, Any]:
    """Return an object; `material` has the named keys, of which None removes one."""
    material = GRIP | keys.pop("material", {})
    return {"name": name, "shape": shape, "material": {k: v for k, v in material.items() if v is not None}, **keys}


def facing(normal: ArrayLike) -> list[float]:
    """Return the quaternion that rotates +z to `normal` (3,)."""
    n = np.asarray(normal, float) / np.linalg.norm(normal)
    q = np.array([1.0 + n[2], -n[1], n[0], 0.0])
    return (q / np.linalg.norm(q)).tolist() if np.linalg.norm(q) > 1e-9 else [0.0, 1.0, 0.0, 0.0]


def wall(
    name: str, normal: ArrayLike, material: dict[str, Any] | None = None, offset: float = 0.0, **keys: Any
) -> dict[str, Any]:
    """Return a plane, frictionless by default, `offset` m from the origin along its `normal` (3,)."""
    place = offset * np.asarray(normal, float) / np.linalg.norm(normal)
    where = {"position_m": place.tolist(), "orientation_wxyz": facing(normal)}
    return {"name": name, "shape": "plane", **where, "material": material or {"stiffness_n_per_m": 1000.0}, **keys}


def scene_with(*objects: dict[str, Any], **tables: Any) -> Scene:
    """Return a scene without a velocity filter, so that a tick depends on two poses only; None removes a table."""
    scene = {
        "fingertip": {"radius_m": R},
        "rolling": {"method": "midpoint"},
        "coupling": {"stiffness_n_per_m": 1000.0, "damping_ns_per_m": 0.0},
        "probe": {"velocity_time_constant_s": 0.0},
        "object": list(objects),
        **tables,
    }
    return build(Scene, {k: v for k, v in scene.items() if v is not None}, "meshes")


def engine(*objects: dict[str, Any], **tables: Any) -> Engine:
    return Engine(scene_with(*objects, **tables))


def posed(points: ArrayLike, turned: Array | None = None) -> Array:
    """Return poses (n, 7) at `points` (n, 3) m, upright or `turned` (n, 4)."""
    places = np.asarray(points, float)
    return np.hstack([places, np.tile([1.0, 0.0, 0.0, 0.0], (len(places), 1)) if turned is None else turned])


def causes(records: Array) -> list[str]:
    return [CAUSE_NAMES[int(cause)] for cause in records["contact.cause"] if cause != 0]


def visit(running: Engine, points: ArrayLike, turned: Array | None = None) -> Array:
    """Return the records of a visit to each of `points` (n, 3)."""
    return running.run(posed(points, turned))


def spun(axis: Sequence[float], angles: ArrayLike) -> Array:
    """Return quaternions (n, 4) of rotations by `angles` (n,) rad about a unit vector."""
    half = 0.5 * np.asarray(angles)[:, None]
    return np.hstack([np.cos(half), np.sin(half) * np.asarray(axis, float)])


def wander(seed: int, ticks: int, reach: float, speed: float = 1e-4) -> Array:
    """Return points (ticks, 3) m of a smooth path through a box of half extent `reach`, about 0.1 mm per tick."""
    rng = np.random.default_rng(seed)
    waves = rng.normal(size=(6, 3, 2)) / np.arange(1, 7)[:, None, None]
    t = np.arange(ticks)[:, None] * speed / reach
    path = np.zeros((ticks, 3))
    for k, a in enumerate(waves):
        path += a[:, 0] * np.sin((k + 1) * t) + a[:, 1] * np.cos((k + 1) * t)
    return reach * path / np.abs(path).max()
