"""Dispatch by the type of the first argument, compiled or in plain Python.

A scene is a tree of named tuples. `@by_type` declares an operation on nodes, `.of(Kind, ...)` implements it for some
kinds, and `.otherwise` for all kinds without an implementation. `.of(None)` implements it for a missing part of the
scene; no default replaces it. The choice is made at compile time, so a scene runs only the code of the parts it has.

For kinds of which all are known in one place, a kernel with `isinstance` is simpler (`compiler/passes.py`).
"""

import functools
import inspect
from collections.abc import Callable
from types import NoneType
from typing import Any, Final

from softfinger.proxy.kernels.jit.cache import written_in
from softfinger.proxy.kernels.jit.compiler.numba_internals import KernelChoice
from softfinger.proxy.kernels.jit.compiler.passes import class_of
from softfinger.proxy.kernels.jit.decorators import PLAIN, jit

_OTHERS: Final = object()


def by_type_with_default(default: Callable[..., Any]) -> Any:
    """Declare a kernel as by `by_type`; the function is the implementation for all kinds without an implementation."""
    choice = by_type(default)
    choice.otherwise(default)
    return choice


def _forwarding(declaration: Callable[..., Any], kernels: Any) -> Callable[..., Any]:
    """Return a function with the parameters of `declaration` that calls the kernel for the first one.

    The code is generated: with `*rest` instead of these parameters, a tick in plain Python takes a third longer.
    """
    parameters = list(inspect.signature(declaration).parameters)
    scope = {"kernels": kernels}
    exec(f"def call({', '.join(parameters)}): return kernels[type({parameters[0]})]({', '.join(parameters)})", scope)
    return functools.wraps(declaration)(scope["call"])


def by_type(declaration: Callable[..., Any]) -> Any:
    """Declare a kernel that each kind of node implements with `.of(Kind)`, or `.otherwise` for all other kinds.

    A kind is identified by its class, wherever that is defined: another package adds kinds with `.of(Kind)`, without
    further registration. `.has(kind)` is True for a kind with a registered kernel.
    """
    kernels: dict[Any, Callable[..., Any]] = {}

    def kernel_for(kind: Any) -> Callable[..., Any] | None:
        return kernels.get(kind) if kind is None or kind in kernels else kernels.get(_OTHERS)

    class Chosen(dict[Any, Callable[..., Any]]):
        """Cache of the kernel for each class: a scene in plain Python makes hundreds of choices a tick."""

        def __missing__(self, kind: type) -> Callable[..., Any]:
            own = None if kind is NoneType else kind
            kernel = kernel_for(own)
            if kernel is None:
                raise TypeError(f"{declaration.__qualname__} is not defined for {own}")
            self[kind] = kernel
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
        choice = _forwarding(declaration, chosen)
    else:
        choice = KernelChoice(
            declaration,
            lambda node, *rest: kernel_for(class_of(node)),
            lambda node, *rest: chosen[type(node)](node, *rest),
        )
    choice.of = of
    choice.has = kernels.__contains__
    choice.otherwise = of(_OTHERS)
    return choice
