"""Kernels that are compiled once and called, for queries too large to stand at every place that asks.

Everything else is compiled into its callers (`jit`). A scene asks `closest` of each object at some ten places: what is
small is fastest there, what is large would be compiled ten times over. A shape with a large query says

    @outlined
    def nearest_triangle(shape, x): ...

    @closest.of(Mesh)
    def closest_on_mesh(shape, x):
        return nearest_triangle(shape, x)
"""

import secrets
from collections.abc import Callable
from typing import Any, Final, TypeVar

import numba
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.lowering import Lower

from softfinger.proxy.kernels.native.compiler.pipeline import PartCompiler, PartLowering
from softfinger.proxy.kernels.native.jit import INLINED, PLAIN, on_call

Kernel = TypeVar("Kernel", bound=Callable[..., Any])

_PROCESS: Final = secrets.token_hex(8)
"""In the symbols of this process. A kept kernel brings the code of what it calls along under the name that it had where
it was compiled; the linker takes the first of a name that it meets, and numba's own names are unique in a process only.
"""


class _Lower(Lower):  # type: ignore[misc]
    def setup_function(self, fndesc: Any) -> None:
        super().setup_function(fndesc)
        self.function.attributes.add("noinline")


@register_pass(mutates_CFG=True, analysis_only=False)
class _Lowering(PartLowering):
    _name = "softfinger_outlined_lowering"

    @property
    def lowering_class(self) -> type[Lower]:
        return _Lower


class _Compiler(PartCompiler):
    lowering = _Lowering

    def define_pipelines(self) -> list[PassManager]:
        identity = self.state.func_id
        identity.unique_id = f"{identity.unique_id}_{_PROCESS}"
        return super().define_pipelines()


def outlined(function: Kernel) -> Kernel:
    """Compile a kernel once for each type of arguments, and call it from wherever it is asked."""
    if PLAIN:
        return function
    options = INLINED | {"forceinline": False, "pipeline_class": _Compiler}
    return on_call(numba.njit(**options)(function))
