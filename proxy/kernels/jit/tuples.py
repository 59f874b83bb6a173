"""Operations on tuples that numba lacks: replace fields of a named tuple, and fill a tuple of another's length.

Kernels and the servo loop call them; in plain Python they are ordinary functions.
"""

from typing import Any

from numba import types
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.extending import intrinsic

from softfinger.proxy.kernels.jit.decorators import PLAIN


@intrinsic(prefer_literal=True)
def replace(typing_context, given, *changes):  # type: ignore[no-untyped-def]
    """Return the named tuple with some fields replaced, as `_replace` does; the new values may have other types.

    given    named tuple
    changes  name and new value of each field, alternating; names are literals
    """
    names = [getattr(each, "literal_value", None) for each in changes[::2]]
    if not set(names) <= set(given.fields):  # numba then tries again without literals
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


@intrinsic
def first_of(typing_context, each, thing, others):  # type: ignore[no-untyped-def]
    """Return a tuple of the length of `each`: `thing` first, then `others` in every other element."""
    count = len(each)
    result = types.BaseTuple.from_types((thing,) + (others,) * (count - 1))

    def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
        return context.make_tuple(builder, result, (args[1],) + (args[2],) * (count - 1))

    return result(each, thing, others), generate


def _first_of(each: Any, thing: Any, others: Any) -> Any:
    return (thing,) + (others,) * (len(each) - 1)


if PLAIN:
    first_of = _first_of
