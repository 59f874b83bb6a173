"""Functions of shapes that can touch a fingertip at several points: meshes and height maps.

Each triangle of a mesh counts as an object. Every other shape uses the defaults.

    nearest_of_shape(shape, x, within, ...)  -> NearestObject    nearest of its objects
    neighbour_of(shape, x)                   -> number           of the object across an edge, relative to this one
    raised_clear(shape, x, radius)           -> (3,) m           a point that is certainly outside
    shade_normal(shape, pose, normal, pos.)  -> (3,)             direction of the force
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.dispatch import by_type_with_default
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.shapes.protocol import closest

NO_LIMIT_M = 1e300
"""Search distance without a limit, m."""
ENOUGH_SHARE = 1.0 - 1e-6
"""Share of the search distance below which any triangle of a mesh is accepted, nearest or not: it obstructs the
fingertip by more than rounding."""


class NearestObject(NamedTuple):
    """Object nearest to a point.

    gap           m  signed distance; only a lower bound if the budget was exhausted
    object_index     -1 for none
    budget           remaining budget, below 0 if a mesh or a height map exhausted it
    """

    gap: float
    object_index: float
    budget: int


@by_type_with_default
def nearest_of_shape(shape: Any, x: Vec3, within: float, known: Vec3, budget: int) -> NearestObject:
    """Return `query.objects.find_deepest` of one shape, in its frame; the index counts from its first object."""
    gap, _, _ = closest(shape, x)
    return NearestObject(gap, 0.0, budget)


@by_type_with_default
def neighbour_of(shape: Any, x: Vec3) -> float:
    """Return the index, relative to this object, of the object across the edge closest to `x`; 0 for this object."""
    return 0.0


@by_type_with_default
def raised_clear(shape: Any, x: Vec3, radius: float) -> Vec3:
    """Return a point where a fingertip, perhaps inside at `x` (3,) m, is certainly outside."""
    return x


@by_type_with_default
def shade_normal(shape: Any, pose: Any, normal: Vec3, position: Vec3) -> Vec3:
    """Return the unit vector (3,) of the normal force of a shape without texture, for a probe at `position` (3,) m."""
    return normal
