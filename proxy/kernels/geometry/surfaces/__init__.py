"""Geometry of each shape: the only folder to extend for a new surface, with one file per family.

See `contract` for what a shape has to give. A package of its own may give the same for shapes of its own.
"""

from softfinger.proxy.kernels.geometry.surfaces import ellipsoid, grown, heightmap, plane, round, sharp, tiles, torus
from softfinger.proxy.kernels.geometry.surfaces.contract import (
    NO_HIT,
    ahead,
    bend,
    closest,
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
    "NO_HIT",
    "ahead",
    "bend",
    "closest",
    "curvature",
    "ellipsoid",
    "follows",
    "grown",
    "heightmap",
    "is_hollow",
    "plane",
    "rest_on",
    "round",
    "sharp",
    "tangent_plane",
    "tiles",
    "torus",
    "transport",
    "travel",
    "unroll",
]
