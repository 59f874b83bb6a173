"""Kernels that are compiled once, kept by themselves, and called by their address.

Everything else is compiled into its callers (`jit`). What is large would be compiled at each place that asks it, and
again for each scene. A kernel that is outlined has machine code of its own for each type of its arguments, which every
kernel of every scene calls:

    @outlined
    def nearest_triangle(shape: Mesh, x: Vec3) -> Found: ...

    @closest.of(Mesh)
    def closest_on_mesh(shape, x):
        return nearest_triangle(shape, x)

The return annotation says of which type the result is. Whoever calls the kernel needs to know no more, so what is on
the disk is loaded without a look at the source. Where the annotation names no type (`Any`, or a tuple that has one),
the compiler infers it. A call passes two addresses, of its arguments and of where the result goes: with the tuples of a
whole contact that is some 40 ns, so what every tick calls for each contact is not outlined. The linker finds the code
by a symbol, in which kernel, types and sources are hashed; before a kept kernel is loaded all that it calls is
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

from softfinger.proxy.kernels.jit.compiler.numba_internals import Choice, link_unit
from softfinger.proxy.kernels.jit.decorators import KEPT, PLAIN, entry, jit

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

_ADDRESS: Final = ir.IntType(8).as_pointer()


def _example(annotation: Any) -> Any:
    """A value of the type that an annotation names, None where it names none."""
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
    """Compile a kernel once for each type of arguments, and call it from wherever it is asked."""
    return outlined_where(lambda *given: True)(function)


def outlined_where(holds: Callable[..., bool]) -> Callable[[Kernel], Kernel]:
    """`outlined` for arguments of those types that `holds` is true of; for others compiled into its callers (`jit`)."""
    return lambda function: function if PLAIN else _declare(function, holds)


def _declare(function: Kernel, holds: Callable[..., bool]) -> Any:
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
        return link_unit(function, KEPT, given, lambda: in_and_out(inner, given, result))

    @intrinsic
    def call_unit(typing_context, *args):  # type: ignore[no-untyped-def]
        given, result = types.Tuple(args), annotated()
        if result is None:
            result = typing_context.resolve_function_type(numba.typeof(inner), args, {}).return_type
        symbol = symbol_for(given, result)

        def generate(context, builder, signature, values):  # type: ignore[no-untyped-def]
            there = cgutils.alloca_once(builder, context.get_value_type(given))
            back = cgutils.alloca_once(builder, context.get_value_type(result))
            builder.store(context.make_tuple(builder, given, values), there)
            code = cgutils.get_or_insert_function(
                builder.module, ir.FunctionType(ir.VoidType(), [_ADDRESS, _ADDRESS]), symbol
            )
            builder.call(code, [builder.bitcast(each, _ADDRESS) for each in (there, back)])
            return builder.load(back)

        return result(*args), generate

    choice: Any = Choice(
        function, lambda *args: call_unit if holds(*args) else inner, lambda *args: from_python()(*args)
    )
    return choice


def in_and_out(inner: Any, given: types.Type, result: types.Type) -> Callable[[Any, Any], None]:
    """A C function of two addresses: of the arguments, and of where the result goes."""

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

    def unit(arguments: Any, there: Any) -> None:
        put(there, inner(*take(arguments)))

    return unit
