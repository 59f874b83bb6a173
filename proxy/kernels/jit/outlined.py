"""Kernels compiled to separate machine code, which is cached and called by address.

All other kernels are compiled into their callers (`jit`). Inlining would compile a large kernel at every call site, and
again for each scene. An outlined kernel is compiled once for each combination of argument types, and shared by the
kernels of all scenes:

    @outlined
    def nearest_triangle(shape: Mesh, x: Vec3) -> Found: ...

    @closest.of(Mesh)
    def closest_on_mesh(shape, x):
        return nearest_triangle(shape, x)

The return annotation defines the type of the result. A caller needs no other information, so a cached kernel is loaded
without analysis of its source. If the annotation defines no type (`Any`, or a tuple that contains it), the compiler
infers it. A call passes two addresses, of the arguments and of the result. With the tuples of a complete contact that
takes some 40 ns, so kernels called in every tick for each contact are not outlined. The linker finds the code by a
symbol that contains a hash of kernel, types and sources; all callees of a cached kernel are loaded before it
(`numba_internals.load`).
"""

import functools
import typing
from collections.abc import Callable
from typing import Any, Final, TypeVar

import numba
from llvmlite import ir
from numba import types
from numba.core import cgutils
from numba.extending import intrinsic

from softfinger.proxy.kernels.jit.compiler.numba_internals import KernelChoice, link_unit
from softfinger.proxy.kernels.jit.decorators import KERNEL_FOLDER, PLAIN, entry, jit

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

_ADDRESS: Final = ir.IntType(8).as_pointer()


def _example(annotation: Any) -> Any:
    """Return a value of the annotated type; None if the annotation defines no type."""
    if annotation in (float, int, bool):
        return annotation(0)
    if annotation is Any:
        return None
    if typing.get_origin(annotation) is tuple:
        parts = [_example(each) for each in typing.get_args(annotation)]
        return None if None in parts else tuple(parts)
    if hasattr(annotation, "_fields"):
        hints = typing.get_type_hints(annotation)
        parts = [_example(hints[name]) for name in annotation._fields]
        return None if None in parts else annotation(*parts)
    raise TypeError(f"{annotation}: an outlined kernel returns numbers, and tuples of them")


def outlined(function: Kernel) -> Kernel:
    """Compile a kernel once for each combination of argument types; its callers call it by address."""
    return outlined_where(lambda *given: True)(function)


def outlined_where(condition: Callable[..., bool]) -> Callable[[Kernel], Kernel]:
    """Outline a kernel for argument types for which `condition` returns true, otherwise inline it (`jit`)."""
    return lambda function: function if PLAIN else _declare(function, condition)


def _declare(function: Kernel, condition: Callable[..., bool]) -> Any:
    inner = jit(function)

    @functools.cache
    def from_python() -> Any:
        return entry(function)

    @functools.cache
    def annotated() -> types.Type | None:
        example = _example(typing.get_type_hints(function)["return"])
        return None if example is None else numba.typeof(example)

    @functools.cache
    def symbol_for(given: types.Type, result: types.Type) -> str:
        return link_unit(function, KERNEL_FOLDER, given, lambda: in_and_out(inner, given, result))

    @intrinsic
    def call_unit(typing_context, *args):  # type: ignore[no-untyped-def]
        given, result = types.Tuple(args), annotated()
        if result is None:
            result = typing_context.resolve_function_type(numba.typeof(inner), args, {}).return_type
        symbol = symbol_for(given, result)

        def generate(context, builder, signature, values):  # type: ignore[no-untyped-def]
            arguments_slot = cgutils.alloca_once(builder, context.get_value_type(given))
            result_slot = cgutils.alloca_once(builder, context.get_value_type(result))
            builder.store(context.make_tuple(builder, given, values), arguments_slot)
            code = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(ir.VoidType(), [_ADDRESS, _ADDRESS]), symbol
            )
            builder.call(code, [builder.bitcast(each, _ADDRESS) for each in (arguments_slot, result_slot)])
            return builder.load(result_slot)

        return result(*args), generate

    choice: Any = KernelChoice(
        function, lambda *args: call_unit if condition(*args) else inner, lambda *args: from_python()(*args)
    )
    return choice


def in_and_out(inner: Any, given: types.Type, result: types.Type) -> Callable[[Any, Any], None]:
    """Return a C function of two addresses, of the arguments and of the result, that calls `inner`."""

    @intrinsic
    def take(typing_context, address):  # type: ignore[no-untyped-def]
        def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
            return builder.load(builder.bitcast(args[0], context.get_value_type(given).as_pointer()))

        return given(address), generate

    @intrinsic
    def put(typing_context, address, value):  # type: ignore[no-untyped-def]
        def generate(context, builder, signature, args):  # type: ignore[no-untyped-def]
            builder.store(args[1], builder.bitcast(args[0], context.get_value_type(result).as_pointer()))
            return context.get_dummy_value()

        return types.void(address, result), generate

    def unit(arguments: Any, result_address: Any) -> None:
        put(result_address, inner(*take(arguments)))

    return unit
