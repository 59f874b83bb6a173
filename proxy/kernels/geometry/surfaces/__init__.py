"""Geometry of each shape: the only folder to extend for a new surface, with one file per family.

See `contract` for what a shape has to give. A package of its own may give the same for shapes of its own.
"""

from softfinger.proxy.kernels.geometry.surfaces import ellipsoid, footing, grown, heightmap, plane, round, sharp, torus
from softfinger.proxy.kernels.geometry.surfaces.contract import (
    BUDGET_OF_A_ROLL,
    NO_HIT,
    ahead,
    bend,
    closest,
    closest_from,
    closest_or_bound,
    closest_within,
    curvature,
    follows,
    held_at,
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
    "curvature",
    "ellipsoid",
    "follows",
    "footing",
    "grown",
    "heightmap",
    "held_at",
    "is_hollow",
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
