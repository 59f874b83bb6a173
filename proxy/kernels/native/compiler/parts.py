"""Code of kernels that only kernels call: kept as a part, and made machine code of with what calls it.

numba optimises every function as a whole and makes machine code of it, with all that it calls in it. A scene's step is
some two hundred functions, one in the other a dozen deep: each would go through LLVM again at every level, and the
machine code of all but the outermost be thrown away. Here a function is simplified by itself, and waits; the outermost
takes all of them in at once. What LLVM computes with numbers is the same in whatever order it does so.
"""

from functools import cache
from typing import Any

from llvmlite import binding as llvm
from llvmlite.binding import newpassmanagers
from numba.core.codegen import Codegen, JITCodeLibrary


@cache
def _simplification(codegen: Codegen) -> tuple[Any, Any]:
    """Passes over one function that leave little of what numba writes for every variable."""
    passes = newpassmanagers.create_new_function_pass_manager()
    passes.add_sroa_pass()
    passes.add_simplify_cfg_pass()
    passes.add_instruction_combine_pass()
    return passes, codegen._pass_builder()


class Part(JITCodeLibrary):  # type: ignore[misc]
    """The code of one function, for others to take in."""

    _shared_module: Any

    def _optimize_functions(self, ll_module: Any) -> None:
        ll_module.data_layout = self._codegen._data_layout
        passes, builder = _simplification(self._codegen)
        for function in ll_module.functions:
            if not function.is_declaration:
                passes.run(function, builder)

    def finalize(self) -> None:
        self._raise_if_finalized()
        for library in self._linking_libraries:
            self._reload_init.update(library._reload_init)
        for function in self._final_module.functions:
            if not function.is_declaration and function.linkage == llvm.Linkage.external:
                function.linkage = llvm.Linkage.weak_odr  # several may bring it along, and the linker leaves none out
        self._finalized = True

    def get_pointer_to_function(self, name: str) -> int:
        return 0

    def _get_module_for_linking(self) -> Any:
        """This function and all that it calls, each once."""
        if self._shared_module is None:
            module = self._final_module.clone()
            for library in self._below({}):
                own = library._final_module if isinstance(library, Part) else library._get_module_for_linking()
                module.link_in(own, preserve=True)
            for function in module.functions:
                if function.linkage == llvm.Linkage.weak_odr:
                    function.linkage = llvm.Linkage.linkonce_odr  # as numba has it: gone where it is not called
            self._shared_module = module
        return self._shared_module

    def _below(self, found: dict[Any, None]) -> dict[Any, None]:
        for library in self._linking_libraries:
            if library not in found:
                found[library] = None
                if isinstance(library, Part):
                    library._below(found)
        return found
