"""Functions chosen by the type of their first argument, compiled or in plain Python.

A scene is a tree of named tuples. `@by_type` declares what every kind of node can do, `.of(Kind, ...)`
says how some kinds do it, `.otherwise` how all those do it that have no own way. `.of(None)` is the case
of a part the scene does not have; no default stands in for it. The choice is made while compiling, so a
scene runs only the code of the parts it has.
"""

import functools
from collections.abc import Callable
from typing import Any, Final

from numba import types

from softfinger.proxy.kernels.jit.cache import written_in
from softfinger.proxy.kernels.jit.compiler.numba_internals import Choice
from softfinger.proxy.kernels.jit.decorators import PLAIN, jit

_OTHERS: Final = object()


def _kind_of(numba_type: types.Type) -> type | None:
    # A named tuple whose fields all have one type is a NamedUniTuple, not a NamedTuple: ask for the class.
    if isinstance(numba_type, types.NoneType):
        return None
    return getattr(numba_type, "instance_class", None) or type(numba_type)


def _kind_of_class(kind: type) -> type | None:
    return None if kind is type(None) else kind


def by_type(declaration: Callable[..., Any]) -> Any:
    """Declare a kernel that each kind of node implements with `.of(Kind)`, or all others with `.otherwise`.

    A kind is known by its class, wherever that is defined: a package of its own adds kinds by `.of(Kind)` alone.
    """
    return chosen_by(declaration, type, _kind_of_class, _kind_of)


def by_type_of(field: str) -> Callable[[Callable[..., Any]], Any]:
    """`by_type`, by a field of the first argument, a named tuple."""
    return lambda declaration: chosen_by(
        declaration,
        lambda node: type(getattr(node, field)),
        _kind_of_class,
        lambda node: _kind_of(node[node.fields.index(field)]),
    )


def chosen_by(
    declaration: Callable[..., Any],
    sort: Callable[[Any], Any],
    kind_of: Callable[[Any], Any],
    compiled_kind: Callable[[types.Type], Any],
) -> Any:
    """A kernel chosen by its first argument.

    `.has(kind)` tells whether a kind has a kernel of its own.

    sort           what plain Python chooses by: the argument's type, or its length
    kind_of        the kind for a sort
    compiled_kind  the kind for numba's type of the argument
    """
    kernels: dict[Any, Callable[..., Any]] = {}

    def kernel_for(kind: Any) -> Callable[..., Any] | None:
        return kernels.get(kind) if kind is None or kind in kernels else kernels.get(_OTHERS)

    class Chosen(dict[Any, Callable[..., Any]]):
        """The kernel for each sort that was met: a scene in plain Python makes hundreds of choices a tick."""

        def __missing__(self, of: Any) -> Callable[..., Any]:
            kernel = kernel_for(kind_of(of))
            if kernel is None:
                raise TypeError(f"{declaration.__qualname__} is not defined for {kind_of(of)}")
            self[of] = kernel
            return kernel

    chosen = Chosen()

    @functools.wraps(declaration)
    def call(node: Any, *rest: Any) -> Any:
        return chosen[sort(node)](node, *rest)

    def of(*kinds: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
        def register(kernel: Callable[..., Any]) -> Callable[..., Any]:
            compiled: Callable[..., Any] = jit(kernel)
            for kind in kinds:
                kernels[kind] = compiled
                written_in(kind, kernel.__code__.co_filename)
            chosen.clear()
            return compiled

        return register

    choice: Any = call if PLAIN else Choice(declaration, lambda node, *rest: kernel_for(compiled_kind(node)), call)
    choice.of = of
    choice.has = kernels.__contains__
    choice.otherwise = of(_OTHERS)
    return choice
