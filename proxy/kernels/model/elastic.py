"""Elastic surface of a mesh, and its displacement under a fingertip."""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.kernels.model.vectors import Vec3


class Elastic(NamedTuple):
    """Compliance of the surface of the only object of a scene.

    compliance  (nodes nodes 9,)  row-major: block a, b is the displacement (3,) of a under unit loads (3,) on b, in the
                                  object frame, m/N times 1 Pa
    nodes       (vertices,)       int64: node at a vertex of the mesh, -1 if it is rigid
    node_count                    number of nodes
    softness    1/Pa              1/E
    damping     s                 time constant of a displacement
    bending     (nodes 6,)        for each node and direction x, y, z of a unit load on it: the largest rotation and the
                                  largest strain of the body, 1/N times 1 Pa
    large       m                 displacement above which the linear solution is not valid
    """

    compliance: ReadOnly
    nodes: ReadOnly
    node_count: float
    softness: float
    damping: float
    bending: ReadOnly
    large: float


class Surface(NamedTuple):
    """Surface under a fingertip.

    displacement        (3,) m    in the object frame
    change              (3,) m    of the displacement since the last tick
    inverse             (3, 3)    blocks of the inverse of Newton's matrix, one per finger: first correction of the next
                                  tick
    rate                (3,) m/s  filtered rate of the displacement
    world_displacement  (3,) m    displacement in the world frame, 0 without contact
    nonlinear                     bits of `contact.nonlinear`
    """

    displacement: Vec3
    change: Vec3
    inverse: Any
    rate: Vec3
    world_displacement: Vec3
    nonlinear: float
