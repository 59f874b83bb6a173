"""Functions chosen by the type of their first argument, compiled or in plain Python.

A scene is a tree of named tuples. `@by_type` declares what every kind of node can do, `.of(Kind)`
says how one kind does it; `.of(None)` is the case of a part the scene does not have. The choice is
made while compiling, so a scene runs only the code of the parts it has.
"""

import functools
import inspect
from collections.abc import Callable
from typing import Any

from numba import types
from numba.extending import overload

from softfinger.proxy.kernels.jit import INLINED, jit


def _kind_of(numba_type: types.Type) -> type | None:
    # A named tuple whose fields all have one type is a NamedUniTuple, not a NamedTuple: ask for the class.
    if isinstance(numba_type, types.NoneType):
        return None
    return getattr(numba_type, "instance_class", None) or type(numba_type)


def _bare_signature(function: Callable[..., Any]) -> inspect.Signature:
    # numba insists that a kernel has the signature of its declaration, annotations included; those differ.
    plain = [
        parameter.replace(annotation=inspect.Parameter.empty)
        for parameter in inspect.signature(function).parameters.values()
    ]
    return inspect.Signature(plain)


def by_type(declaration: Callable[..., Any]) -> Any:
    """Declare a kernel that each kind of node implements with `.of(Kind)`."""
    return _declare(declaration, lambda node: None if node is None else type(node), _kind_of)


def by_count(declaration: Callable[..., Any]) -> Any:
    """Declare a kernel chosen by the length of a tuple: `.of(1)` for exactly one, `.of(2)` for two and more."""
    return _declare(declaration, lambda nodes: min(len(nodes), 2), lambda nodes: min(len(nodes), 2))


def _declare(
    declaration: Callable[..., Any], key: Callable[[Any], Any], compiled_key: Callable[[types.Type], Any]
) -> Any:
    kernels: dict[Any, Callable[..., Any]] = {}

    @functools.wraps(declaration)
    def call(node: Any, *rest: Any) -> Any:
        return kernels[key(node)](node, *rest)

    def of(kind: Any) -> Callable[[Callable[..., Any]], Callable[..., Any]]:
        def register(kernel: Callable[..., Any]) -> Callable[..., Any]:
            kernels[kind] = kernel
            kernel.__signature__ = _bare_signature(kernel)  # type: ignore[attr-defined]
            compiled: Callable[..., Any] = jit(kernel)
            return compiled

        return register

    def choose(node: types.Type, *rest: types.Type) -> Callable[..., Any] | None:
        return kernels.get(compiled_key(node))

    choose.__signature__ = _bare_signature(declaration)  # type: ignore[attr-defined]
    overload(call, jit_options=INLINED)(choose)
    call.of = of  # type: ignore[attr-defined]
    return call
