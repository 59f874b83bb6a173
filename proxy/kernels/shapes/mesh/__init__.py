"""Triangle meshes: the tree over the triangles, its construction, and the search of the nearest triangle of millions.

Only this folder depends on the memory layout of the tree. A contact treats a triangle as an object like any other.
"""

from softfinger.proxy.kernels.shapes.mesh import contact

__all__ = ["contact"]
