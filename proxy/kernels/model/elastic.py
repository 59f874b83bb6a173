"""Elastic surface of a mesh, and its displacement under a fingertip."""

from typing import NamedTuple

from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.kernels.model.vectors import Vec3


class Elastic(NamedTuple):
    """Compliance of the surface of the only object of a scene.

    compliance  (nodes nodes 9,)  row-major: block a, b is the displacement (3,) of a under unit loads (3,) on b, in the
                                  object frame, m/N times 1 Pa
    nodes       (vertices,)       int64: node at a vertex of the mesh, -1 where it does not give
    number                        number of nodes
    softness    1/Pa              1/E
    damping     s                 time constant of a displacement
    """

    compliance: ReadOnly
    nodes: ReadOnly
    number: float
    softness: float
    damping: float


class Surface(NamedTuple):
    """Displacement (3,) m of the surface under a fingertip, in the object frame, and its filtered rate (3,) m/s."""

    displacement: Vec3
    rate: Vec3
