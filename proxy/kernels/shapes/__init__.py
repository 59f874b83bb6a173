"""Geometry of the shapes: a file for each family of simple shapes, a folder for each shape that needs a search.

A new shape is added in this folder only: importing its module registers it. `protocol` lists the functions that a
shape implements; another package can implement them for its shapes, too. The builders of meshes and
height maps (`proxy/meshes/tree.py`, `proxy/heightmaps.py`) import their folders: most scenes have neither.
"""

from softfinger.proxy.kernels.shapes import ellipsoid, minkowski, plane, round, sharp  # noqa: F401 - registration
from softfinger.proxy.kernels.shapes.protocol import *
