"""Tuples as long as others, and named tuples with some of their fields changed."""

from typing import Any

from numba import types
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.extending import intrinsic

from softfinger.proxy.kernels.jit.decorators import PLAIN
from softfinger.proxy.kernels.jit.dispatch import by_count


@intrinsic(prefer_literal=True)
def replace(typing_context, given, *changes):  # type: ignore[no-untyped-def]
    """The named tuple `given` with other values, of other types, too, in some fields: a field's name and its value,
    again and again."""
    names = [getattr(each, "literal_value", None) for each in changes[::2]]
    if not set(names) <= set(given.fields):  # numba asks once more then, without the literals
        raise TypingError(f"{given.instance_class.__name__} has no fields of these names: {changes[::2]}")
    at, kinds = [given.fields.index(name) for name in names], dict(zip(given.fields, given.types, strict=True))
    kinds |= {given.fields[place]: types.unliteral(kind) for place, kind in zip(at, changes[1::2], strict=True)}
    result = types.BaseTuple.from_types(tuple(kinds.values()), given.instance_class)

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        values, new = cgutils.unpack_tuple(builder, args[0]), cgutils.unpack_tuple(builder, args[1])
        for place, value in zip(at, new[1::2], strict=True):
            values[place] = value
        return context.make_tuple(builder, result, values)

    return result(given, types.Tuple(changes)), generate


def _replaced(given: Any, *changes: Any) -> Any:
    return given._replace(**dict(zip(changes[::2], changes[1::2], strict=True)))


if PLAIN:
    replace = _replaced


@by_count
def same_for(each: Any, thing: Any) -> Any:
    """A tuple of the same thing for each in another."""


@same_for.of(1)
def same_for_one(each: Any, thing: Any) -> Any:
    return (thing,)


@same_for.of(2)
def same_for_several(each: Any, thing: Any) -> Any:
    # numba joins tuples of known types, and does not unpack one inside another.
    return (thing,) + same_for(each[1:], thing)  # noqa: RUF005


@by_count
def first_of(each: Any, thing: Any, others: Any) -> Any:
    """A tuple as long as another, of a thing and, behind it, the same other thing for each that follows."""


@first_of.of(1)
def only_one(each: Any, thing: Any, others: Any) -> Any:
    return (thing,)


@first_of.of(2)
def first_of_several(each: Any, thing: Any, others: Any) -> Any:
    return (thing,) + same_for(each[1:], others)  # noqa: RUF005  # see above
