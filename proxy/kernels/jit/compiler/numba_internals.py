"""Undocumented parts of numba and llvmlite, all used in this file, `convention.py` and `passes.py` only.

Their purposes, and the consequences without them:

_nrt                     Kernels have no allocator. Without: an allocation in the loop compiles, and delays a tick.
forceinline              A small kernel is compiled into its callers. Without: a cached kernel contains functions under
                         names that are unique in one process only, and the linker uses the ones of another.
no_cpython_wrapper, no_cfunc_wrapper
                         Kernels called only by kernels have no wrapper. Without: a scene compiles for 1.6 times as
                         long.
CPUDispatcher.compile and its members: overloads, _compiler, _compiling_counter, insert_user_function, trigger_event
                         Such a kernel is compiled without timers of locks. Without: a scene compiles for 1.06 times as
                         long.
get_call_template        Its arguments are not literals. Without: it is compiled again for each literal, in ten places
                         of a scene with several objects.
CPUDispatcher, types.Dispatcher
                         Such a kernel has a dispatcher when a caller is compiled, and is compiled again when called
                         from Python. Without: numba jumps to address 0.
add_llvm_module, _optimize_functions, _optimize_final_module, _codegen
                         Such a kernel is optimised lightly. Without: a scene compiles for 1.14 times as long.
finalize, _linking_libraries, _final_module, _get_module_for_linking
                         A small kernel that calls large ones is not optimised at all. Without: `lift-a-box` compiles
                         for 1.2 times as long, and takes 1.7 times the disk space.
NativeLowering, register_pass, LoweringPass, _LowerResult, Lower, CPUCallConv, ArgPacker, PythonFunctionDescriptor,
get_or_insert_function, get_executable, _defns, StarArgTuple, StarArgUniTuple (all in `convention.py`)
                         A tuple is one argument of such a kernel. Without: LLVM gets three times as much code, and a
                         scene compiles for 1.1 times as long.
_find_singly_assigned_variable, _singly_assigned_vars, _blk_local_varmap, _cur_ir_block, pre_block, storevar,
RETCODE_OK (in `convention.py`), Compiler.define_pipelines, enable_object_caching
                         Variables are values, never deleted; kernels that cannot fail are not checked; machine code is
                         optimised once. Without all of these: a scene compiles for 1.2 times as long.
FunctionPass, _definitions, build_definitions, compute_cfg_from_blocks, simplify_CFG (in `passes.py`)
                         `isinstance` of arguments is evaluated before type inference. Without: it does not compile.
PassManager, _runPass, _analysis, DefaultPassBuilder and its passes (in `passes.py`)
                         Such a kernel is compiled without timers and checks of each pass, and without passes that
                         have no effect in it. Without: 11 % more calls.
PostProcessor, canonicalize_cfg, TranslateByteCode, Interpreter.post_process and its peepholes (all in `passes.py`),
CompilerBase.__init__, refresh
                         Lifetimes of variables, `with` and new registrations are not searched for in such a kernel.
                         Without: 19 % more calls.
TypeInferer, constraints, callstack, WarningsFixer, resolve_function_type, typingctx (in `passes.py`), lower_binop
(in `convention.py`)
                         Statements and functions of scalars are typed once. Without: 16 % more calls.
global_compiler_lock     Needed where no dispatcher compiles. Without: an assertion of numba fails.
JITCodeLibrary, get_executable, compile_result, CompilerBase
                         Such a kernel has no machine code. Without: a scene takes 1.5 times the disk space.
_cache, NullCache, serialize.dumps, CompileResult._reduce and ._rebuild, lifted, has_dynamic_globals
                         A cache that trusts no other user (`cache.py`). Without: numba unpickles any file found, and
                         ends the program if a file is damaged.
magic_tuple, _final_module, refresh
                         The processor of a cached kernel, and its callees. Without: a kernel with a missing callee
                         ends the program.
CFunc, cpu_target, get_pointer_to_function, llvm_cfunc_wrapper_name
                         C functions in that cache, and under a symbol. Without: `numba.cfunc` uses numba's cache.
types.Callable, types.Dispatcher, resolve_value_type, lower_constant
                         A kernel chosen by type is cached, too. Without: `overload` compiles it for every scene.

TESTED_VERSIONS names the versions of numba tested with these. `tests/proxy/test_numba_internals.py` checks all that
results depend on. Read the three files completely before an upgrade of numba.
"""

from __future__ import annotations

import functools
import hashlib
import logging
import pickle
import secrets
from collections.abc import Callable
from typing import Any, Final

import llvmlite.binding as llvm
from numba import types
from numba.core.caching import NullCache
from numba.core.ccallback import CFunc
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler import Compiler, CompilerBase, CompileResult, compile_result
from numba.core.compiler_lock import global_compiler_lock
from numba.core.errors import TypingError
from numba.core.event import trigger_event
from numba.core.imputils import lower_constant
from numba.core.registry import CPUDispatcher, cpu_target
from numba.core.serialize import dumps
from numba.core.sigutils import normalize_signature
from numba.extending import models, register_model, typeof_impl

from softfinger.proxy.kernels.jit.cache import KERNEL_SOURCES, Folder, kinds_in, sources_of
from softfinger.proxy.kernels.jit.compiler.convention import insert_inlined
from softfinger.proxy.kernels.jit.compiler.passes import add_static_conditions, make_passes
from softfinger.proxy.kernels.jit.compiler.progress import COMPILE_PROGRESS

TESTED_VERSIONS: Final = ("0.67", "0.68")
"""Versions of numba with which all of this was tested."""

WITHOUT_ALLOCATOR: Final = {"_nrt": False}
WITHOUT_WRAPPERS: Final = {"no_cfunc_wrapper": True}
FOR_KERNELS: Final = {"no_cpython_wrapper": True, "forceinline": True}

UNIT_PREFIX: Final = "softfinger_unit_"
"""Prefix of the symbols of outlined kernels."""

log: Final = logging.getLogger(__name__)


class KernelCache(NullCache):  # type: ignore[misc]
    """Disk cache of one kernel, as numba's dispatchers use it: one file for each kernel and signature.

    kind  of code: a kernel that is compiled in two ways is cached twice
    """

    def __init__(self, function: Callable[..., Any], folder: Folder, kind: str = "") -> None:
        self._function, self._folder, self._kind = function, folder, kind
        self._own = sources_of(function.__code__.co_filename)
        self._missing = dict[Any, Any]()  # keys of kernels that are not cached, by signature

    @property
    def cache_path(self) -> str:
        return str(self._folder.path)

    def load_overload(self, signature: Any, target_context: Any) -> Any:
        """Return the compiled kernel, or None.

        numba's cache first prepares numba to compile, which imports half of it, and SciPy if that is installed. Machine
        code needs only the addresses of its callees; `compile` does the preparation itself.
        """
        key = self.key(signature, target_context.codegen())
        compiled = None if key is None else load(self._folder, self._name(key), target_context, key)
        if compiled is None:
            self._missing[signature] = key
        return compiled

    def save_overload(self, signature: Any, compiled: Any) -> None:
        """Store a compiled kernel if possible."""
        key = self._missing.pop(signature)
        if key is not None:
            self.save(self._name(key), key, compiled)

    def save(self, name: str, key: tuple[Any, ...], compiled: Any) -> None:
        if compiled.lifted or compiled.library.has_dynamic_globals:
            log.warning("%s is compiled at every start: it contains addresses of this process", self._function)
            return
        self._folder.write(name, dumps((key, _calls(compiled.library), compiled._reduce())))

    def key(self, signature: Any, codegen: Any) -> tuple[Any, ...] | None:
        """Return everything that determines the kernel's code; None if part of it is unknown."""
        files = [sorted(KERNEL_SOURCES.get(kind, {}).items()) for kind in kinds_in(signature)]
        sources = [self._own, *(content for each in files for _, content in each)]
        if None in sources:
            return None
        cells = tuple(cell.cell_contents for cell in self._function.__closure__ or ())
        code = self._function.__code__
        try:
            made = hashlib.sha256(code.co_code + (dumps(cells) if cells else b"")).hexdigest()
        except Exception:  # an object that cannot be pickled: each type raises another exception
            return None
        place = f"{self._kind} {self._function.__module__}.{self._function.__qualname__}:{code.co_firstlineno}"
        return place, signature, codegen.magic_tuple(), made, sources

    def _name(self, key: tuple[Any, ...]) -> str:
        # Without the sources, so that an edited kernel replaces the previous file.
        return f"{self.stem()}-{hashlib.sha256(repr(key[:4]).encode()).hexdigest()[:32]}.kernel"

    def stem(self) -> str:
        return "".join(letter if letter.isalnum() else "_" for letter in self._function.__qualname__)[:80]


def load(folder: Folder, name: str, target_context: Any, key: tuple[Any, ...] | None = None) -> Any:
    """Load a cached kernel with all its callees as numba's CompileResult.

    Returns None if it is missing, invalid, or compiled for another key than `key`.
    """
    with COMPILE_PROGRESS.loading():
        body = folder.read(name)
        if body is None:
            return None
        try:
            cached_key, calls, reduced = pickle.loads(body)
            if key is not None and cached_key != key:
                return None
            units = [each for each in calls if each.startswith(UNIT_PREFIX)]
            if not all(_linked(folder, each, target_context) for each in units):
                return None
            if not all(llvm.address_of_symbol(each) is not None for each in calls):  # symbols of numba's runtime
                target_context.refresh()
            rebuild = InlinedCode.rebuild if reduced[0][1] == InlinedCode.FORM else CompileResult._rebuild
            return rebuild(target_context, *reduced)
        except Exception as error:  # written by another version of a library
            folder.reject(name, error)
            return None


def _calls(library: Any) -> list[str]:
    """Return the symbols that machine code requires from the process; LLVM ends the program if one is missing."""
    module = library._final_module
    names = [each.name for each in (*module.functions, *module.global_variables) if each.is_declaration]
    return [name for name in names if not name.startswith("llvm.")]


LARGE_CALLEE_BYTES: Final = 20_000
LARGE_CALLEE_RATIO: Final = 10
"""A kernel is not optimised if the code of its callees has more bytes than this, and more times as many as its own."""


class UnitCode(JITCodeLibrary):  # type: ignore[misc]
    """Machine code of a kernel that Python or C calls, with the kernels that are compiled into it."""

    def _optimize_functions(self, ll_module: Any) -> None:
        ll_module.data_layout = self._codegen._data_layout

    def _optimize_final_module(self) -> None:
        """Optimise once; numba would do it twice, because of reference counts."""
        passes, builder = self._codegen._module_pass_manager()
        passes.run(self._final_module, builder)


class UnitCompiler(Compiler):  # type: ignore[misc]
    """Compiler of a kernel with machine code."""

    def define_pipelines(self) -> list[Any]:
        self.state.library = UnitCode(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        self.state.library.enable_object_caching()
        pipelines: list[Any] = super().define_pipelines()
        add_static_conditions(pipelines[0])
        return pipelines


class InlinedCode(JITCodeLibrary):  # type: ignore[misc]
    """Code of a kernel that is compiled into its callers: optimised LLVM code, without unused machine code."""

    FORM: Final = "inlined"

    def finalize(self) -> None:
        own = len(self._final_module.as_bitcode())
        callees = sum(len(each.bitcode) for each in set(self._linking_libraries) if isinstance(each, InlinedCode))
        self._is_optimised = callees < max(LARGE_CALLEE_BYTES, LARGE_CALLEE_RATIO * own)
        super().finalize()

    def add_llvm_module(self, ll_module: Any) -> None:
        """Store the code of the kernel, which only `_optimize_final_module` optimises."""
        ll_module.data_layout = self._codegen._data_layout
        self._final_module = ll_module

    def _optimize_final_module(self) -> None:
        """Optimise once, and lightly: callers are optimised again, with the inlined code. Twice takes 14 % longer.

        If nearly all of the code is that of callees, which are optimised, the kernel is left to its callers.
        """
        if self._is_optimised:
            passes, builder = self._codegen._module_pass_manager(opt=1, loop_vectorize=False, slp_vectorize=False)
            passes.run(self._final_module, builder)

    def _get_module_for_linking(self) -> Any:
        return self._final_module

    def _finalize_final_module(self) -> None:
        for each in self._final_module.functions:
            if not each.is_declaration:
                each.linkage = "linkonce_odr"  # removed when it is compiled into all callers
        self._finalize_dynamic_globals()
        self._finalized = True

    @functools.cached_property
    def bitcode(self) -> bytes:
        """Code with that of the callees."""
        code: bytes = self._final_module.as_bitcode()
        return code

    def get_pointer_to_function(self, name: str) -> int:
        return 0

    def serialize_using_object_code(self) -> tuple[str, str, bytes]:
        return self.name, self.FORM, self.bitcode

    @classmethod
    def rebuild(cls, context: Any, code: Any, described: Any, environment: Any, signature: Any, *rest: Any) -> Any:
        """Return the CompileResult of a kernel with such code, from the output of `CompileResult._reduce`."""
        name, _, bitcode = code
        library = cls(context.codegen(), name)
        library._final_module = llvm.parse_bitcode(bitcode)
        library._finalize_final_module()
        return compile_result(
            target_context=context,
            library=library,
            fndesc=described,
            environment=environment,
            signature=signature,
            objectmode=False,
            entry_point=context.get_executable(library, described, environment),
            referenced_envs=rest[-1],  # so they exist as long as the result
        )

    @property
    def codegen(self) -> InlinedCode:
        """Return self: numba reads this property only to call `set_env`."""
        return self

    def set_env(self, name: str, environment: Any) -> None:
        """Do nothing: only functions called from Python use an environment, and numba would write to address 0."""


class _RefreshedContext:
    """Context of numba that the compiler of the caller has refreshed."""

    def __init__(self, context: Any) -> None:
        self._context = context

    def __getattr__(self, name: str) -> Any:
        return getattr(self._context, name)

    def refresh(self) -> None:
        """Do nothing."""


class InlinedCompiler(CompilerBase):  # type: ignore[misc]
    """Compiler of a kernel that is called only by kernels."""

    def __init__(self, typing_context: Any, target_context: Any, *rest: Any) -> None:
        super().__init__(_RefreshedContext(typing_context), _RefreshedContext(target_context), *rest)
        self.state.typingctx = typing_context

    def define_pipelines(self) -> list[Any]:
        self.state.library = InlinedCode(self.state.targetctx.codegen(), self.state.func_id.func_qualname)
        return [make_passes(self.state)]


class InlinedDispatcher(CPUDispatcher):  # type: ignore[misc]
    """Dispatcher that compiles a kernel once for a literal and a variable of its type.

    It does not time numba's locks: in nested compilations, each level would time each call of LLVM.
    """

    def get_call_template(self, args: Any, kws: Any) -> Any:
        known = {name: types.unliteral(kind) for name, kind in kws.items()}
        return super().get_call_template(tuple(map(types.unliteral, args)), known)

    def compile(self, sig: Any) -> Any:
        with global_compiler_lock, self._compiling_counter:
            args, result = normalize_signature(sig)
            if (known := self.overloads.get(tuple(args))) is not None:
                return known.entry_point
            if (compiled := self._cache.load_overload(sig, self.targetctx)) is not None:
                self._cache_hits[sig] += 1
                insert_inlined(self.targetctx, compiled.entry_point, compiled.fndesc, compiled.library)
                self.add_overload(compiled)
                return compiled.entry_point
            self._cache_misses[sig] += 1
            with trigger_event("numba:compile", data={"dispatcher": self, "args": args, "return_type": result}):
                compiled = self._compiler.compile(args, result)
                self.add_overload(compiled)
            self._cache.save_overload(sig, compiled)
            return compiled.entry_point


class InlinedKernel:
    """Kernel for other kernels, without a Python wrapper.

    Its dispatcher is made when a kernel that calls it is compiled: a program imports hundreds of kernels, and a scene
    whose kernels are cached needs few of them.

    cache   of its compiled code, None for none
    called  function that compiles the kernel for Python: without a wrapper numba jumps to address 0
    """

    def __init__(
        self,
        function: Callable[..., Any],
        options: dict[str, Any],
        cache: KernelCache | None,
        called: Callable[[Any], Any],
    ) -> None:
        functools.update_wrapper(self, function)
        self.py_func, self._options, self._cache, self._called = function, options, cache, called

    @functools.cached_property
    def dispatcher(self) -> Any:
        """Numba's dispatcher of the kernel."""
        options = {"nopython": True} | self._options
        made: Any = InlinedDispatcher(self.py_func, targetoptions=options, pipeline_class=InlinedCompiler)
        if self._cache is not None:
            made._cache = self._cache
        return made

    @functools.cached_property
    def _from_python(self) -> Callable[..., Any]:
        compiled: Callable[..., Any] = self._called(self.py_func)
        return compiled

    def __call__(self, *args: Any) -> Any:
        return self._from_python(*args)

    def __reduce__(self) -> Any:
        """Pickle the dispatcher: the key of a cached kernel includes the kernels in its closure."""
        return self.dispatcher.__reduce__()


class _KernelType(types.Dispatcher):  # type: ignore[misc]
    """numba type of a kernel: as an argument it has no value, since its type determines the code.

    numba's type has the address of the dispatcher as its value, and a kernel with such an address is not cached.
    """


register_model(_KernelType)(models.OpaqueModel)


@typeof_impl.register(InlinedKernel)
def _type_of_dispatcher(value: InlinedKernel, context: Any) -> types.Dispatcher:
    return _KernelType(value.dispatcher)


class KernelChoice:
    """Kernel with several implementations under one name.

    declaration  its signature and docstring
    choose       returns the implementation for numba's types of the arguments, None without one
    plain        implementation for calls from Python
    """

    def __init__(self, declaration: Callable[..., Any], choose: Callable[..., Any], plain: Callable[..., Any]) -> None:
        functools.update_wrapper(self, declaration)
        self.name = f"{declaration.__module__}.{declaration.__qualname__}"
        self.choose, self._plain = choose, plain

    def __call__(self, *args: Any) -> Any:
        return self._plain(*args)

    @functools.cached_property
    def numba_type(self) -> _KernelChoiceType:
        return _KernelChoiceType(self)


class _KernelChoiceType(types.Callable, types.Opaque):  # type: ignore[misc]
    """numba type of a KernelChoice: calls resolve to the chosen implementation."""

    def __init__(self, choice: KernelChoice) -> None:
        self._choice, self._chosen = choice, dict[Any, Any]()
        super().__init__(name=f"KernelChoice({choice.name} {id(choice)})")

    def get_call_type(self, context: Any, args: Any, kws: Any) -> Any:
        known, named = tuple(map(types.unliteral, args)), {name: types.unliteral(kind) for name, kind in kws.items()}
        kernel = self._choice.choose(*known)
        if kernel is None:
            raise TypingError(f"{self._choice.name} is not defined for {known}")
        chosen = context.resolve_value_type(kernel)
        signature = chosen.get_call_type(context, known, named)
        self._chosen[signature.args] = chosen
        takes_any = any(each.kind == each.VAR_POSITIONAL for each in signature.pysig.parameters.values())
        return signature.replace(pysig=None) if takes_any else signature  # numba would search for them in a tuple

    def get_call_signatures(self) -> tuple[list[Any], bool]:
        return [], True

    def get_impl_key(self, signature: Any) -> Any:
        return self._chosen[signature.args].get_impl_key(signature)


register_model(_KernelChoiceType)(models.OpaqueModel)


@typeof_impl.register(KernelChoice)
def _typeof(value: KernelChoice, context: Any) -> _KernelChoiceType:
    return value.numba_type


@lower_constant(_KernelType)
@lower_constant(_KernelChoiceType)
def _nothing(context: Any, builder: Any, kind: Any, value: Any) -> Any:
    return context.get_dummy_value()


class CFunction(CFunc):
    """Kernel with a C address, compiled on first access to the address."""

    def __init__(self, function: Callable[..., Any], signature: Any, cache: Any = None, **options: Any) -> None:
        given = {"error_model": "numpy"} | options
        super().__init__(function, (signature.args, signature.return_type), {}, given, pipeline_class=UnitCompiler)
        self._cache = NullCache() if cache is None else cache

    @property
    def address(self) -> int | None:
        if super().address is None:
            self.compile()
        return super().address

    def _compile_uncached(self) -> Any:
        """Compile, and record it in COMPILE_PROGRESS: numba sends no event for C functions."""
        COMPILE_PROGRESS.begin()
        try:
            return super()._compile_uncached()  # type: ignore[misc]
        finally:
            COMPILE_PROGRESS.end()


_LINKED: Final[dict[str, Any]] = {}
"""Code of outlined kernels in this process by symbol: numba's libraries, which own the memory."""


def _link(symbol: str, compiled: Any) -> None:
    address = compiled.library.get_pointer_to_function(compiled.fndesc.llvm_cfunc_wrapper_name)
    llvm.add_symbol(symbol, address)
    _LINKED[symbol] = compiled.library


def _linked(folder: Folder, symbol: str, target_context: Any) -> bool:
    """Return whether the process has an outlined kernel, after loading it if necessary."""
    if symbol not in _LINKED:
        compiled = load(folder, f"{symbol}.kernel", target_context)
        if compiled is None:
            return False
        _link(symbol, compiled)
    return True


_IN_AND_OUT: Final = types.void(types.voidptr, types.voidptr)


@global_compiler_lock
def link_unit(function: Callable[..., Any], folder: Folder, given: Any, make: Callable[[], Callable[..., Any]]) -> str:
    """Return the symbol of a kernel for arguments of the types `given`, a tuple; load or compile its code if necessary.

    make  returns the C function to compile: void of two addresses
    """
    cache, context = KernelCache(function, folder, "unit"), cpu_target.target_context
    key = cache.key((given,), context.codegen())
    classes = [f"{kind.__module__}.{kind.__qualname__}" for kind in kinds_in((given,))]
    unique = secrets.token_hex(16) if key is None else hashlib.sha256(repr((key, classes)).encode()).hexdigest()[:32]
    symbol = f"{UNIT_PREFIX}{cache.stem()}_{unique}"
    if key is None or not _linked(folder, symbol, context):
        compiled = CFunction(make(), _IN_AND_OUT, **WITHOUT_ALLOCATOR)._compile_uncached()
        _link(symbol, compiled)
        if key is not None:
            cache.save(f"{symbol}.kernel", key, compiled)
    return symbol


def code_of(symbol: str) -> str:
    """Return the LLVM code of an outlined kernel compiled in this process, empty for one loaded from disk."""
    return str(_LINKED[symbol].get_llvm_str())
