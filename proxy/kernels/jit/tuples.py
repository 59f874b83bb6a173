"""Tuples as long as others."""

from typing import Any

from softfinger.proxy.kernels.jit.dispatch import by_count


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
