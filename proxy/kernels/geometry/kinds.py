"""Which objects may be touched in many places: what a scene without any leaves out, known when it is compiled."""

from collections.abc import Callable
from typing import Any, Final

from numba import literal_unroll

from softfinger.proxy.kernels.geometry.entries import has, places
from softfinger.proxy.kernels.model import Heightmap, Mesh
from softfinger.proxy.kernels.native.dispatch import by_type, chosen_by
from softfinger.proxy.kernels.native.jit import jit
from softfinger.proxy.kernels.native.kept import kinds_in
from softfinger.proxy.kernels.native.rows import Rows


def has_wide(*given: Any) -> bool:
    """Whether there is a mesh or a height map among arguments of those types: what is asked of one is large, and takes
    long enough for a call by address not to count."""
    return not {Mesh, Heightmap}.isdisjoint(kinds_in(given))


SMOOTH: Final = "smooth"
FACETED: Final = "faceted"
RUGGED: Final = "rugged"


def _roughest(kinds: Any) -> str:
    return RUGGED if Heightmap in kinds else FACETED if Mesh in kinds else SMOOTH


def by_roughness(declaration: Callable[..., Any]) -> Any:
    """Declare a kernel chosen by what there is in a tuple of objects: `.of(RUGGED)` a height map, `.of(FACETED)` a mesh
    and no height map, `.of(SMOOTH)` neither. Of the others nothing is compiled."""

    def sort(objects: Any) -> str:
        return _roughest({type((entry[0] if isinstance(entry, Rows) else entry).shape) for entry in objects})

    return chosen_by(declaration, sort, lambda kind: kind, lambda objects: _roughest(kinds_in(tuple(objects))))


@by_type
def is_faceted(shape: Any) -> Any:
    """1 for a shape that is many flat ones, each an object of its own."""


@is_faceted.otherwise
def is_whole(shape: Any) -> float:
    return 0.0


@is_faceted.of(Mesh)
def is_mesh(shape: Mesh) -> float:
    return 1.0


@by_type
def is_rugged(shape: Any) -> Any:
    """1 for a shape that may hold a fingertip in several places, as one body."""


@is_rugged.otherwise
def is_even(shape: Any) -> float:
    return 0.0


@is_rugged.of(Heightmap)
def is_heightmap(shape: Heightmap) -> float:
    return 1.0


@by_type
def shape_in(entry: Any) -> Any:
    """The shape of an entry, or of the first of a row, whose others are of its kind."""


@shape_in.otherwise
def shape_of_object(entry: Any) -> Any:
    return entry.shape


@shape_in.of(Rows)
def shape_of_first(entry: Any) -> Any:
    return entry[0].shape


@jit
def any_faceted(objects: Any) -> bool:
    """Whether there is a mesh among them."""
    found = 0.0
    for entry in literal_unroll(objects):
        found += is_faceted(shape_in(entry))
    return found > 0.0


@jit
def any_rugged(objects: Any) -> bool:
    """Whether there is a height map among them."""
    found = 0.0
    for entry in literal_unroll(objects):
        found += is_rugged(shape_in(entry))
    return found > 0.0


@jit
def any_wide(objects: Any) -> bool:
    """Whether there is one of either."""
    return any_faceted(objects) or any_rugged(objects)


@jit
def kind_on(objects: Any, index: float) -> float:
    """Of the object with that place: 1 a triangle of a mesh, 2 a height map, 0 anything else, or nothing."""
    kind = 0.0
    at = 0.0
    for entry in literal_unroll(objects):
        if has(entry, at, index):
            kind = is_faceted(shape_in(entry)) + 2.0 * is_rugged(shape_in(entry))
        at += places(entry)
    return kind


@jit
def faceted_on(objects: Any, index: float) -> bool:
    """Whether the object with that place is a triangle of a mesh."""
    return kind_on(objects, index) == 1.0


@jit
def rugged_on(objects: Any, index: float) -> bool:
    """Whether the object with that place is a height map."""
    return kind_on(objects, index) == 2.0
