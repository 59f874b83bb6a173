"""numba's passes over a kernel, without those that find nothing to do in one."""

from types import CodeType
from typing import Any, ClassVar

from numba import _dynfunc
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import PassManager, register_pass
from numba.core.typed_passes import AnnotateTypes, DumpParforDiagnostics, NativeLowering, NopythonRewrites
from numba.core.untyped_passes import InlineClosureLikes, WithLifting

from softfinger.proxy.kernels.native.compiler.parts import Part

_IDLE = {
    WithLifting,  # a part in Python
    NopythonRewrites,  # expressions of whole arrays, which would allocate
    AnnotateTypes,  # a listing for people
    DumpParforDiagnostics,  # parallel loops
}


class KernelCompiler(CompilerBase):  # type: ignore[misc]
    """Compiles a kernel that Python, or C, calls."""

    lowering: ClassVar[type] = NativeLowering

    def define_pipelines(self) -> list[PassManager]:
        idle = _IDLE if _has_functions(self.state.func_id.code) else _IDLE | {InlineClosureLikes}
        passes = DefaultPassBuilder.define_nopython_pipeline(self.state)
        passes.passes = [
            (self.lowering if each is NativeLowering else each, said)
            for each, said in passes.passes
            if each not in idle
        ]
        passes.finalize()
        return [passes]


def _has_functions(code: CodeType) -> bool:
    """Whether functions are written in it: lambdas, comprehensions."""
    return any(isinstance(each, CodeType) for each in code.co_consts)


@register_pass(mutates_CFG=True, analysis_only=False)
class PartLowering(NativeLowering):  # type: ignore[misc]
    """Lowering to a Part."""

    _name = "softfinger_part_lowering"

    def run_pass(self, state: Any) -> bool:
        context, identity = state.targetctx, state.func_id
        state.library = Part(context.codegen(), identity.func_qualname)
        state.flags.no_compile = True
        super().run_pass(state)
        made = state.cr
        # What numba does with what it has compiled; there is no address, for nobody but kernels calls it.
        function = _dynfunc.make_function(
            made.fndesc.lookup_module(), identity.func_name, "", 0, made.env, (state.library,)
        )
        context.insert_user_function(function, made.fndesc, [state.library])
        state.cr = made._replace(cfunc=function)
        return True


class PartCompiler(KernelCompiler):
    """Compiles a kernel that only kernels call."""

    lowering = PartLowering
