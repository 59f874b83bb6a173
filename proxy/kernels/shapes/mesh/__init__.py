"""Triangle meshes: the tree over the triangles, how it is built, and the nearest triangle of millions.

Here and nowhere else it is known how the tree lies in memory. No contact: a triangle is an object like others to it.
"""

from softfinger.proxy.kernels.shapes.mesh import contact

__all__ = ["contact"]
