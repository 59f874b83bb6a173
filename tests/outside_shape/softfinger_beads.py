"""Shape in a separate package: any number of balls that form one solid, with sizes in a read-only array.

The search over the balls has the same code for any number, and is compiled once per scene.
"""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, NamedTuple

import numpy as np

from softfinger.config.schema import ObjectBase, add_shape, doc
from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.kernels.jit.outlined import outlined
from softfinger.proxy.kernels.numerics import vec3
from softfinger.proxy.kernels.shapes import closest, curvature
from softfinger.proxy.kernels.shapes.protocol import Z_AXIS, any_tangent, compute_direction
from softfinger.proxy.scene import Body, shape_bodies


class Beads(NamedTuple):
    """`count` balls; `balls` has x, y, z of the centre and the radius of each ball in turn, m."""

    count: float
    balls: ReadOnly


@outlined
def nearest_bead(shape: Beads, x: Any) -> tuple[float, tuple[float, float, float], float]:
    """Return gap, centre and radius of the ball with the smallest gap."""
    least, center, radius = 1e300, (0.0, 0.0, 0.0), 0.0
    for i in range(int(shape.count)):
        middle = (shape.balls[4 * i], shape.balls[4 * i + 1], shape.balls[4 * i + 2])
        gap = vec3.norm(vec3.sub(x, middle)) - shape.balls[4 * i + 3]
        if gap < least:
            least, center, radius = gap, middle, shape.balls[4 * i + 3]
    return least, center, radius


@closest.of(Beads)
def closest_on_beads(shape: Beads, x: Any) -> Any:
    gap, center, radius = nearest_bead(shape, x)
    _, normal = compute_direction(vec3.sub(x, center), Z_AXIS)
    return gap, vec3.add_scaled(center, radius, normal), normal


@curvature.of(Beads)
def curvature_of_beads(shape: Beads, radius: float, point: Any, normal: Any) -> Any:
    _, _, own = nearest_bead(shape, point)
    return 1.0 / (own + radius), 1.0 / (own + radius), any_tangent(normal)


@add_shape
class BeadsTable(ObjectBase, frozen=True, kw_only=True, tag_field="shape", tag="beads"):
    """Balls listed in a file."""

    shape: ClassVar[str] = "beads"
    balls_file: Annotated[str, doc("a line for each ball: x, y, z and radius, m", "balls.txt")]


@shape_bodies.register
def _beads(table: BeadsTable) -> list[Body]:
    balls = np.loadtxt(table.balls_file, ndmin=2)
    return [Body(Beads(float(len(balls)), ReadOnly(balls)))]
