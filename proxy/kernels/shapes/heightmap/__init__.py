"""Height maps: the spline surface, its tiles, the nearest point, and a fingertip on several support points.

Independent of other shapes and of the objects of a scene.
"""

from softfinger.proxy.kernels.shapes.heightmap import multipoint, nearest, surface

__all__ = ["multipoint", "nearest", "surface"]
