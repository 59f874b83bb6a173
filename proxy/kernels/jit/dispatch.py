"""Dispatch by the type of the first argument, compiled or in plain Python.

A scene is a tree of named tuples. `@by_type` declares an operation on nodes, `.of(Kind, ...)` implements it for some
kinds, and `.otherwise` for all kinds without an implementation. `.of(None)` implements it for a missing part of the
scene; no default replaces it. The choice is made at compile time, so a scene runs only the code of the parts it has.
"""

import functools
import inspect
from collections.abc import Callable
from typing import Any, Final

from numba import types

from softfinger.proxy.kernels.jit.cache import written_in
from softfinger.proxy.kernels.jit.compiler.numba_internals import Choice
from softfinger.proxy.kernels.jit.decorators import PLAIN, jit

_OTHERS: Final = object()


def _kind_of(numba_type: types.Type) -> type | None:
    # A named tuple with fields of one type is a NamedUniTuple, not a NamedTuple: compare its class.
    if isinstance(numba_type, types.NoneType):
        return None
    return getattr(numba_type, "instance_class", None) or type(numba_type)


def _kind_of_class(kind: type) -> type | None:
    return None if kind is type(None) else kind


def by_type(declaration: Callable[..., Any]) -> Any:
    """Declare a kernel that each kind of node implements with `.of(Kind)`, or all others with `.otherwise`.

    A kind is identified by its class, wherever that is defined: another package adds kinds with `.of(Kind)`, without
    further registration.
    """
    return chosen_by(declaration, type, _kind_of_class, _kind_of)


def by_type_with_default(default: Callable[..., Any]) -> Any:
    """Declare a kernel as by `by_type`; the function is the implementation for all kinds without one of their own."""
    choice = by_type(default)
    choice.otherwise(default)
    return choice


def by_type_of(field: str) -> Callable[[Callable[..., Any]], Any]:
    """Declare a kernel chosen as by `by_type`, by the type of a field of the first argument, a named tuple."""
    return lambda declaration: chosen_by(
        declaration,
        lambda node: type(getattr(node, field)),
        _kind_of_class,
        lambda node: _kind_of(node[node.fields.index(field)]),
    )


def _forwarding(declaration: Callable[..., Any], kernels: Any, sort: Callable[[Any], Any]) -> Callable[..., Any]:
    """Return a function with the parameters of `declaration` that calls the kernel for the first one.

    The code is generated: with `*rest` instead of these parameters, a tick in plain Python takes a third longer.
    """
    parameters = inspect.signature(declaration).parameters.values()
    names = ", ".join(f"*{each.name}" if each.kind == each.VAR_POSITIONAL else each.name for each in parameters)
    node = next(iter(parameters)).name
    scope = {"kernels": kernels, "sort": sort}
    exec(f"def call({names}): return kernels[sort({node})]({names})", scope)
    return functools.wraps(declaration)(scope["call"])


def chosen_by(
    declaration: Callable[..., Any],
    sort: Callable[[Any], Any],
    kind_of: Callable[[Any], Any],
    compiled_kind: Callable[[types.Type], Any],
) -> Any:
    """Return a kernel chosen by its first argument.

    `.has(kind)` tells whether a kind has a kernel of its own.

    sort           property of the argument by which plain Python chooses: its type, or its length
    kind_of        kind for a value of `sort`
    compiled_kind  kind for numba's type of the argument
    """
    kernels: dict[Any, Callable[..., Any]] = {}

    def kernel_for(kind: Any) -> Callable[..., Any] | None:
        return kernels.get(kind) if kind is None or kind in kernels else kernels.get(_OTHERS)

    class Chosen(dict[Any, Callable[..., Any]]):
        """Cache of the kernel for each value of `sort`: a scene in plain Python makes hundreds of choices a tick."""

        def __missing__(self, of: Any) -> Callable[..., Any]:
            kernel = kernel_for(kind_of(of))
            if kernel is None:
                raise TypeError(f"{declaration.__qualname__} is not defined for {kind_of(of)}")
            self[of] = kernel
            return kernel

    chosen = Chosen()

    def of(*kinds: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
        def register(kernel: Callable[..., Any]) -> Callable[..., Any]:
            compiled: Callable[..., Any] = jit(kernel)
            for kind in kinds:
                kernels[kind] = compiled
                written_in(kind, kernel.__code__.co_filename)
            chosen.clear()
            return compiled

        return register

    choice: Any
    if PLAIN:
        choice = _forwarding(declaration, chosen, sort)
    else:
        choice = Choice(
            declaration,
            lambda node, *rest: kernel_for(compiled_kind(node)),
            lambda node, *rest: chosen[sort(node)](node, *rest),
        )
    choice.of = of
    choice.has = kernels.__contains__
    choice.otherwise = of(_OTHERS)
    return choice
