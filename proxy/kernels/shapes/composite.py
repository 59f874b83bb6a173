"""What a shape can do that is touched in several places at once: a mesh, whose triangles are objects of their own, or a
height map. Every other shape takes the defaults.

    is_mesh_shape(shape)                     -> 0 or 1           whether it is a triangle of a mesh
    has_creases(shape)                       -> 0 or 1           whether it may hold a fingertip in several places
    nearest_of_shape(shape, x, within, ...)  -> Deepest          the nearest of its objects
    neighbour_of(shape, x)                   -> number           of the object beyond an edge, counted from this one
    element_of_shape(shape, facet)           -> shape            the object that is one of its triangles
    raised_clear(shape, x, radius)           -> (3,) m           a place outside for certain
    shaded(shape, pose, normal, position)    -> (3,)             the direction in which it presses
"""

from typing import Any, NamedTuple

from softfinger.proxy.kernels.jit.dispatch import by_type
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.shapes.protocol import closest

EVERYWHERE = 1e300
"""Farther, m, than any gap."""
ENOUGH = 1.0 - 1e-6
"""Share of the gap that is asked about, below which a triangle of a mesh need not be the very nearest: it is in the
way, and not by a rounding error."""


@by_type
def is_mesh_shape(shape: Any) -> Any:
    """1 for a triangle of a mesh."""


@is_mesh_shape.otherwise
def is_no_mesh(shape: Any) -> float:
    return 0.0


@by_type
def has_creases(shape: Any) -> Any:
    """1 for a shape that may hold a fingertip in several places, as one body."""


@has_creases.otherwise
def has_no_creases(shape: Any) -> float:
    return 0.0


class Deepest(NamedTuple):
    """The object nearest to a point: the gap (m), its place, -1 for none, and what is left of the budget; below 0 it
    was used up on a mesh or a height map, and the gap may be only a bound below which nothing is."""

    gap: float
    place: float
    budget: int


@by_type
def nearest_of_shape(shape: Any, x: Vec3, within: float, known: Vec3, budget: int) -> Any:
    """`query.objects.deepest` of one shape, in its frame; `place` and `known` are indices of triangles, 0 of others."""


@nearest_of_shape.otherwise
def gap_of_it(shape: Any, x: Vec3, within: float, known: Vec3, budget: int) -> Deepest:
    gap, _, _ = closest(shape, x)
    return Deepest(gap, 0.0, budget)


@by_type
def neighbour_of(shape: Any, x: Vec3) -> Any:
    """How far on in the tuple the object is that lies beyond the edge of this one at which `x` is; 0 for itself."""


@neighbour_of.otherwise
def no_neighbour(shape: Any, x: Vec3) -> float:
    return 0.0


@by_type
def element_of_shape(shape: Any, facet: float) -> Any:
    """Return the triangle of a mesh with that index, another shape itself."""


@element_of_shape.otherwise
def shape_itself(shape: Any, facet: float) -> Any:
    return shape


@by_type
def raised_clear(shape: Any, x: Vec3, radius: float) -> Any:
    """Where a fingertip at `x` (3,) m that is not known to be outside is for certain."""


@raised_clear.otherwise
def raised_not_at_all(shape: Any, x: Vec3, radius: float) -> Vec3:
    return x


@by_type
def shaded(shape: Any, pose: Any, normal: Vec3, position: Vec3) -> Any:
    """Unit vector (3,) along which a shape without a texture presses on the probe at `position` (3,) m."""


@shaded.otherwise
def not_shaded(shape: Any, pose: Any, normal: Vec3, position: Vec3) -> Vec3:
    return normal
