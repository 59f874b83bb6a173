"""Named tuples with some of their fields changed, in a kernel and as plain Python."""

from typing import Any, NamedTuple

import pytest
from numba.core.errors import TypingError

from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.jit.tuples import replace


class Thing(NamedTuple):
    """Fields of three types, one of which is not there."""

    size: float
    place: Any
    number: int


@entry
def moved(thing: Thing, place: Any) -> Any:
    return replace(thing, "place", place, "size", 2.0 * thing.size)


@pytest.mark.plain
@pytest.mark.parametrize("place", [(1.0, 2.0, 3.0), 4.0, (5.0, Thing(6.0, None, 7))])
def test_fields_get_other_values_of_any_type_and_the_rest_stays(place: Any) -> None:
    found = moved(Thing(0.5, None, 3), place)
    assert type(found) is Thing
    assert found == Thing(1.0, place, 3)


def test_a_kernel_does_not_compile_that_names_a_field_which_is_not_there() -> None:
    @entry
    def misspelt(thing: Thing) -> Any:
        return replace(thing, "plaec", 1.0)

    with pytest.raises(TypingError, match="Thing has no fields of these names"):
        misspelt(Thing(0.5, None, 3))
