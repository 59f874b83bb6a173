"""Kinds of objects in a scene, and of one of its objects.

Only meshes and height maps can touch a fingertip at several points. Other scenes are compiled without the code for
that: `isinstance(objects.search, Faceted)` is known at compile time.
"""

from typing import Any

from softfinger.proxy.kernels.jit.cache import kinds_in
from softfinger.proxy.kernels.jit.decorators import jit
from softfinger.proxy.kernels.model import (
    CREASED,
    FACETED,
    SMOOTH,
    AnyShape,
    Bodies,
    Creased,
    Facet,
    Faceted,
    Heightmap,
    Many,
    Mesh,
    Smooth,
)
from softfinger.proxy.kernels.query.container import object_at


def moves_by_itself(*given: Any) -> bool:
    """Return True if one of the arguments contains an object attached to a body of a simulation.

    A tick of a simulation takes microseconds, so a call by address costs little. Inlining the code of each finger into
    each of its callers would take a minute to compile.
    """
    return Bodies in kinds_in(given)


def takes_long(*given: Any) -> bool:
    """Return True if one of the arguments contains several objects, a mesh or a height map.

    Queries of them take so long that the cost of a call by address is negligible.
    """
    return not {Many, Mesh, Heightmap}.isdisjoint(kinds_in(given))


@jit
def any_mesh(objects: Any) -> bool:
    """Return True if one of the objects is a mesh."""
    if isinstance(objects, Many) and isinstance(objects.search, Creased):
        return objects.search.meshes > 0.0
    return isinstance(objects.search, Faceted)


@jit
def surface_of(shape: Any) -> float:
    """Return the surface of a shape, see `AnyShape`."""
    if isinstance(shape, AnyShape):
        return shape.surface
    if isinstance(shape, Facet):
        return FACETED
    return CREASED if isinstance(shape, Heightmap) else SMOOTH


@jit
def surface_at(objects: Any, index: float) -> float:
    """Return the surface of object `index`, SMOOTH if `index` names no object."""
    if isinstance(objects.search, Smooth) or index < 0.0:
        return SMOOTH
    return surface_of(object_at(objects, index).shape)


@jit
def is_mesh_at(objects: Any, index: float) -> bool:
    """Return True if object `index` is a triangle of a mesh."""
    return surface_at(objects, index) == FACETED


@jit
def has_creases_at(objects: Any, index: float) -> bool:
    """Return True if object `index` is a height map."""
    return surface_at(objects, index) == CREASED
