"""Geometry of each shape: the only folder to extend for a new surface, with one file per family of
convex shapes and one folder for each that has its own search. The line that imports them is the table of shapes.

See `protocol` for what a shape has to give. A package of its own may give the same for shapes of its own.
"""

from softfinger.proxy.kernels.shapes import ellipsoid, heightmap, mesh, minkowski, plane, round, sharp, torus
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
    "heightmap",
    "is_hollow",
    "mesh",
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
