"""Geometry of each shape: the only folder to extend for a new surface, with one file per family.

See `contract` for what a shape has to give.
"""

from softfinger.proxy.kernels.surfaces import ellipsoid, plane, round, sharp, torus
from softfinger.proxy.kernels.surfaces.contract import closest, curvature, transport

__all__ = ["closest", "curvature", "ellipsoid", "plane", "round", "sharp", "torus", "transport"]
