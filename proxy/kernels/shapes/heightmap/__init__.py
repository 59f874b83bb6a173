"""Height maps: the surface through the heights, its tiles, the nearest point, a fingertip on several support points.

No other shape, and nothing that asks all objects of a scene.
"""

from softfinger.proxy.kernels.shapes.heightmap import multipoint, nearest, surface

__all__ = ["multipoint", "nearest", "surface"]
