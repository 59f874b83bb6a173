"""Geometry of the shapes: a file for each family of simple shapes, a folder for each shape that needs a search.

A new shape is added in this folder only: importing its module registers it. `protocol` lists the functions that a
shape implements; another package can implement them for its shapes, too. What builds a mesh or a height map
(`proxy/meshes/tree.py`, `proxy/heightmaps.py`) imports its folder: most scenes have neither.
"""

from softfinger.proxy.kernels.shapes import ellipsoid, minkowski, plane, round, sharp, torus
from softfinger.proxy.kernels.shapes.protocol import (
    BUDGET_OF_A_ROLL,
    NO_HIT,
    ahead,
    bend,
    closest,
    closest_from,
    closest_or_bound,
    closest_within,
    constraint_at,
    curvature,
    follows,
    is_hollow,
    rest_on,
    tangent_plane,
    transport,
    travel,
    unroll,
)

__all__ = [
    "BUDGET_OF_A_ROLL",
    "NO_HIT",
    "ahead",
    "bend",
    "closest",
    "closest_from",
    "closest_or_bound",
    "closest_within",
    "constraint_at",
    "curvature",
    "ellipsoid",
    "follows",
    "is_hollow",
    "minkowski",
    "plane",
    "rest_on",
    "round",
    "sharp",
    "tangent_plane",
    "torus",
    "transport",
    "travel",
    "unroll",
]
