"""Functions on tuples, in a kernel and as plain Python."""

from typing import Any, NamedTuple

import pytest
from numba.core.errors import TypingError

from softfinger.proxy.kernels.jit.decorators import entry, jit
from softfinger.proxy.kernels.jit.tuples import (
    field_of_each,
    first_of,
    fold_each,
    map_each,
    pad,
    replace,
    same_for,
    unzip,
)


class Item(NamedTuple):
    size: float
    place: Any
    number: int


@entry
def move_item(item: Item, place: Any) -> Any:
    return replace(item, "place", place, "size", 2.0 * item.size)


@pytest.mark.plain
@pytest.mark.parametrize("place", [(1.0, 2.0, 3.0), 4.0, (5.0, Item(6.0, None, 7))])
def test_fields_are_replaced_by_values_of_any_type(place: Any) -> None:
    result = move_item(Item(0.5, None, 3), place)
    assert type(result) is Item
    assert result == Item(1.0, place, 3)


def test_an_unknown_field_name_does_not_compile() -> None:
    @entry
    def misspelt(item: Item) -> Any:
        return replace(item, "plaec", 1.0)

    with pytest.raises(TypingError, match="Item has no fields of these names"):
        misspelt(Item(0.5, None, 3))


@jit
def half_and_third(number: float, second: float, factor: float) -> tuple[float, float]:
    return factor * number / 2.0, factor * second / 3.0


@jit
def behind(number: float, others: tuple[float, float]) -> tuple[float, float]:
    """Return the number, and the sum of `others` with the second weighted twice."""
    return number, others[0] + 2.0 * others[1]


@entry
def of_all(numbers: Any, others: Any, items: Any) -> Any:
    halves, thirds = unzip(map_each(half_and_third, (numbers, others), 6.0))
    none, nothing = unzip(map_each(half_and_third, ((), ()), 6.0))
    return (
        (halves, thirds, none, nothing, fold_each(behind, numbers, (0.0, 0.0))),
        (same_for(numbers, 7.0), first_of(numbers, 1.0, 2.0), pad(numbers, 0.5, 4), field_of_each(items, "size")),
    )


@pytest.mark.plain
@pytest.mark.parametrize("count", [1, 2, 3])
def test_functions_apply_to_tuples_of_any_length(count: int) -> None:
    numbers, others = (1.0, 2.0, 4.0)[:count], (3.0, 6.0, 9.0)[:count]
    items = (Item(0.5, None, 3), Item(1.5, None, 3), Item(2.5, None, 3))[:count]
    mapped, made = of_all(numbers, others, items)
    assert mapped[:4] == (tuple(3.0 * x for x in numbers), tuple(2.0 * x for x in others), (), ())
    assert mapped[4] == {1: (1.0, 0.0), 2: (1.0, 2.0), 3: (1.0, 10.0)}[count]
    assert made[:2] == ((7.0,) * count, (1.0, 2.0, 2.0)[:count])
    assert made[2:] == ((*numbers, *(0.5,) * (4 - count)), (0.5, 1.5, 2.5)[:count])
