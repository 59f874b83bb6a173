"""Undocumented behaviour of numba 0.67 and 0.68 that the kernels depend on. With another version, a failure here shows
what has changed."""

import subprocess
import sys
from pathlib import Path
from typing import Any, NamedTuple

import llvmlite.binding as llvm
import numba
import numpy as np
import pytest
from numba import types
from numba.core.registry import cpu_target

from softfinger.proxy.kernels.jit import decorators
from softfinger.proxy.kernels.jit.cache import Folder
from softfinger.proxy.kernels.jit.compiler import numba_internals
from softfinger.proxy.kernels.jit.compiler.numba_internals import InlinedKernel, KernelCache
from softfinger.proxy.kernels.jit.dispatch import by_type


class One(NamedTuple):
    x: float


class Other(NamedTuple):
    y: float


class More(NamedTuple):
    x: float
    rest: Any


BY_ITSELF = """
from numba import njit
@njit(no_cpython_wrapper=True)
def kernel(x):
    return x
kernel(1.0)
"""


def test_this_numba_version_was_verified() -> None:
    """For a new numba version, run this file and add the version to SEEN."""
    assert numba.__version__.startswith(numba_internals.TESTED_VERSIONS)


def test_kernels_that_allocate_do_not_compile() -> None:
    """`_nrt`: without numba's runtime, a kernel that allocates does not compile."""

    def allocates(n: int) -> float:
        return float(np.zeros(n)[0])

    for compiled in (numba.njit(**decorators.OPTIONS)(allocates), decorators.jit(allocates)):
        with pytest.raises(numba.TypingError):
            compiled(3)
    assert numba.njit(allocates)(3) == 0.0  # default of numba


def test_forced_inlining_leaves_no_function() -> None:
    """`forceinline`: no separate function of a kernel remains in its caller's IR, even with four calls."""

    @decorators.jit
    def long(x: float) -> float:
        for _ in range(100):
            x = x * x + 1.0 / (x + 2.0) if x < 3.0 else np.sqrt(x)
        return x

    outermost: Any = numba.njit(**decorators.OPTIONS)(lambda x: long(x) + long(x + 1.0) + long(x + 2.0) + long(x * 2.0))
    outermost(1.0)
    (ir,) = outermost.inspect_llvm().values()
    assert len([line for line in ir.splitlines() if line.startswith("define ") and "cpython" not in line]) == 1


def test_a_literal_argument_compiles_no_further_kernel() -> None:
    """`get_call_template`: one version is compiled, where numba itself compiles one for each literal."""

    @decorators.jit
    def add(x: float, n: int) -> float:
        return x + n

    kernel: Any = add
    caller: Any = numba.njit(**decorators.OPTIONS)(lambda x, n: kernel(x, n) + kernel(x, 2) + kernel(x, n=3))
    assert caller(1.0, 1) == 9.0
    assert [signature.args for signature in kernel.dispatcher.nopython_signatures] == [(types.float64, types.int64)]


def test_inlined_kernels_have_no_machine_code(tmp_path: Any) -> None:
    """`JITCodeLibrary`, `CompilerBase`: callers use an inlined kernel, compiled or loaded from a file."""

    def half(x: float) -> float:
        return 0.5 * x

    folder, hits = Folder(tmp_path / "kernels"), []
    for _ in range(2):
        kernel: Any = InlinedKernel(half, decorators.INLINED, KernelCache(half, folder, "inlined"), decorators.entry)
        caller: Any = numba.njit(**decorators.OPTIONS)(lambda x, kernel=kernel: kernel(x) + kernel(x + 1.0))
        assert caller(3.0) == 3.5
        hits.append(sum(kernel.dispatcher.stats.cache_hits.values()))
        (made,) = kernel.dispatcher.overloads.values()
        assert isinstance(made.library, numba_internals.InlinedCode) and not made.type_annotation
        assert not cpu_target.target_context.codegen()._engine.is_symbol_defined(made.fndesc.llvm_func_name)
    assert hits == [0, 1]


@pytest.mark.parametrize(("large", "calls"), [(0, 1), (10**9, 0)])
def test_a_small_kernel_with_large_callees_is_left_to_its_callers(monkeypatch, tmp_path, large, calls):
    """`finalize`: its code still calls the callee, and computes the same, compiled or loaded from a file."""
    monkeypatch.setattr(numba_internals, "LARGE_CALLEE_BYTES", large)
    monkeypatch.setattr(numba_internals, "LARGE_CALLEE_RATIO", 0)
    callee: Any = decorators.jit(lambda x: np.sin(x) + 1.0)

    def small(x: float, callee: Any = callee) -> float:
        return callee(x)

    folder = Folder(tmp_path / "kernels")
    for _ in range(2):
        kernel: Any = InlinedKernel(small, decorators.INLINED, KernelCache(small, folder, "inlined"), decorators.entry)
        caller: Any = numba.njit(**decorators.OPTIONS)(lambda x, kernel=kernel: kernel(x) + kernel(2.0 * x))
        assert caller(0.5) == np.sin(0.5) + 1.0 + (np.sin(1.0) + 1.0)
        (made,) = kernel.dispatcher.overloads.values()
        assert str(made.library.get_function(made.fndesc.llvm_func_name)).count("call i32") == calls


def test_a_tuple_is_one_argument_of_an_inlined_kernel(tmp_path: Any) -> None:
    """`convention.py`: results, defaults, `*rest` and errors match Python, compiled and loaded from a file."""

    def move(pair: Any, factor: float = 2.0, *rest: Any) -> Any:
        if factor < 0.0:
            raise ValueError("negative")
        (x, flag), n = pair
        return (x * factor + len(rest), not flag), n + 1, rest

    folder = Folder(tmp_path / "kernels")
    for _ in range(2):
        kernel: Any = InlinedKernel(move, decorators.INLINED, KernelCache(move, folder, "inlined"), decorators.entry)

        def call(pair: Any, factor: float, kernel: Any = kernel) -> Any:
            return kernel(pair), kernel(pair, factor, (1.0, 2.0), (3.0, 4.0))

        caller: Any = numba.njit(**decorators.OPTIONS)(call)
        arguments = ((1.5, True), 7)
        assert caller(arguments, 3.0) == (move(arguments), move(arguments, 3.0, (1.0, 2.0), (3.0, 4.0)))
        with pytest.raises(ValueError, match="negative"):
            caller(arguments, -1.0)
        for made in kernel.dispatcher.overloads.values():
            function = made.library.get_function(made.fndesc.llvm_func_name)
            kinds = [str(argument.type) for argument in function.arguments]
            assert sum(kind.startswith("{ {") for kind in kinds) == 1  # the pair, as one argument


def test_only_kernels_that_can_fail_are_checked() -> None:
    """`RETCODE_OK`: an error passes through a caller that raises none itself."""

    def checked(x: float) -> float:
        if x < 0.0:
            raise ValueError("negative")
        return x

    inner: Any = decorators.jit(checked)
    plain: Any = decorators.jit(lambda x: 2.0 * x)
    outer: Any = decorators.jit(lambda x: plain(inner(x)))
    caller: Any = numba.njit(**decorators.OPTIONS)(lambda x: outer(x))
    assert caller(1.5) == 3.0
    with pytest.raises(ValueError, match="negative"):
        caller(-1.0)
    fails = [next(iter(kernel.dispatcher.overloads.values())).fndesc.fails for kernel in (inner, plain, outer)]
    assert fails == [True, False, True]


@pytest.fixture
def empty_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Kernels of the test are compiled; the user's cache is not used."""
    monkeypatch.setattr(decorators, "KERNEL_FOLDER", Folder(tmp_path / "kernels"))


def test_machine_code_is_optimised_once(monkeypatch: pytest.MonkeyPatch, empty_cache: None) -> None:
    """`UnitCode`: LLVM's passes run once for a kernel called from Python; numba itself runs them twice or more."""
    decorators.entry(lambda x: x)(1.0)  # the first compilation of a process also compiles numba's own functions
    codegen, runs = type(cpu_target.target_context.codegen()), list[str]()
    passes_of = codegen._module_pass_manager

    def count(self: Any, **options: Any) -> Any:
        runs.append("passes")
        return passes_of(self, **options)

    monkeypatch.setattr(codegen, "_module_pass_manager", count)
    kernel: Any = decorators.entry(lambda x: x * x)
    assert kernel(3.0) == 9.0
    assert len(runs) == 1
    assert numba.njit(lambda x: x * x)(3.0) == 9.0
    assert len(runs) > 2


def test_an_inlined_kernel_must_not_return_a_value_or_none() -> None:
    """The caller would interpret the status code of None as an error."""
    kernel: Any = decorators.jit(lambda x: x if x > 0.0 else None)

    @decorators.entry
    def call(x: float) -> bool:
        return kernel(x) is None

    with pytest.raises(numba.TypingError, match="return a flag and a value"):
        call(1.0)


def straight(x: float, n: int) -> Any:
    pair = x, n
    return pair[0] * pair[1] + 1, pair


def branched(x: float, n: int) -> Any:
    total = 1
    if x > 2.0:
        total = n + 1
    elif n:
        x = total / 2.0
    return x + total, (total, x)


def looped(x: float, n: int) -> Any:
    total, last = 0, x
    for i in range(n):
        last = total + 0.5
        total += i
    return total, last


def nested(x: float, n: int) -> Any:
    factor, total = x + 1.0, 0.0
    for i in range(n):
        square = factor * i
        if square > 3.0:
            total += square
            continue
        last = square - factor
        while last < 2.0:
            last += factor
        total -= last
    return total, factor


def renamed(x: float, n: int) -> Any:
    y = x + n
    y = y * 2.0
    return y


def shared(x: float, n: int) -> Any:
    y = x + n
    doubled = lambda: 2.0 * y  # noqa: E731
    y = doubled()
    return y


@pytest.mark.parametrize("function", [straight, branched, looped, nested, renamed, shared])
def test_types_and_results_are_those_of_numba(empty_cache: None, function: Any) -> None:
    """`TypeInferer`, `storevar`, `_blk_local_varmap`, `is_straight`."""
    kernel: Any = decorators.jit(function)
    caller: Any = numba.njit(**decorators.OPTIONS)(lambda x, n: kernel(x, n))
    plain: Any = numba.njit(**decorators.OPTIONS)(function)
    for arguments in ((1.5, 3), (2.5, 0), (0.0, 0), (0.25, 5), (0.25, 1)):
        assert caller(*arguments) == plain(*arguments) == function(*arguments)
    assert kernel.dispatcher.nopython_signatures == plain.nopython_signatures


def test_an_in_place_operation_compiles_for_new_types() -> None:
    """`lower_binop`: numba types it as in place, and generates the code of the plain operation."""

    def subtract(x: Any, y: Any) -> Any:
        x -= y
        return x

    kernel: Any = decorators.jit(subtract)
    assert numba.njit(**decorators.OPTIONS)(lambda x, y: kernel(x, y))(np.float32(5.0), np.float32(1.5)) == 3.5


def test_a_kernel_without_wrapper_is_recompiled_for_python() -> None:
    """`CPUDispatcher`: numba itself calls address 0 and crashes; a kernel of this project returns its result."""
    process = subprocess.run([sys.executable, "-c", BY_ITSELF], capture_output=True, check=False)
    assert process.returncode < 0
    kernel: Any = decorators.jit(lambda x: 2.0 * x)
    assert kernel(2.0) == 4.0
    assert "dispatcher" not in vars(kernel)  # created only for the kernel that calls it, so that imports create none


def test_a_c_function_has_an_address() -> None:
    """`CFunc`: compiled when its address is requested, and callable from C; the linker finds a name added for it."""
    kernel = numba_internals.CFunction(lambda x: 2 * x, types.int64(types.int64))
    assert kernel.native_name is None and kernel.address and kernel.ctypes(21) == 42
    llvm.add_symbol("softfinger_test_symbol", kernel.address)
    assert llvm.address_of_symbol("softfinger_test_symbol") == kernel.address
    assert llvm.address_of_symbol("softfinger_test_symbol_that_is_not") is None


def test_overloads_are_chosen_at_compile_time() -> None:
    """`types.Callable`: the argument's type chooses the implementation, with default and keyword arguments."""

    @by_type
    def total(numbers: Any, factor: float = 2.0) -> Any: ...

    @total.of(One)
    def of_one(numbers: One, factor: float = 2.0) -> float:
        return numbers.x * factor

    @total.of(More)
    def of_more(numbers: More, factor: float = 2.0) -> float:
        return numbers.x * factor + total(numbers.rest, factor)

    outermost: Any = numba.njit(**decorators.OPTIONS)(
        lambda x: (total(One(x)), total(More(x, More(x, One(1.0))), factor=3.0))
    )
    assert isinstance(total, numba_internals.KernelChoice) and outermost(5.0) == (10.0, 33.0)
    assert (total(One(5.0)), total(More(5.0, More(5.0, One(1.0))), 3.0)) == (10.0, 33.0)


def test_conditions_on_types_are_evaluated_before_type_inference() -> None:
    """`_definitions`, `simplify_CFG`: of arguments and their fields; code that is not reached need not compile."""

    @decorators.jit
    def total(numbers: Any) -> Any:
        if isinstance(numbers, (One, Other)):
            return numbers[0]
        if numbers.rest is None or isinstance(numbers.rest, More):
            return numbers.x
        return numbers.x + (10.0 * numbers.rest.x if isinstance(numbers.rest, One) else numbers.rest.y)

    @decorators.entry
    def call(numbers: Any) -> float:
        if isinstance(numbers, More) and numbers.x > 3.0:
            return -total(numbers)
        return total(numbers)

    for numbers, expected in (
        (One(1.0), 1.0), (Other(2.0), 2.0), (More(3.0, None), 3.0), (More(3.0, More(1.0, None)), 3.0),
        (More(3.0, One(2.0)), 23.0), (More(4.0, Other(2.0)), -6.0),
    ):  # fmt: skip
        assert call(numbers) == expected
    wrong: Any = decorators.entry(lambda numbers: isinstance(One(numbers.x), One))  # not a type of an argument
    with pytest.raises(numba.TypingError):
        wrong(One(1.0))


def test_a_kernel_that_is_an_argument_leaves_no_address_in_its_caller() -> None:
    def one(x: float) -> float:
        return x

    inner: Any = InlinedKernel(one, decorators.INLINED, None, numba.njit)

    def caller(x: float) -> float:
        kernel = inner
        return kernel(x)

    library = InlinedKernel(caller, decorators.INLINED, None, numba.njit).dispatcher
    library.compile((types.float64,))
    assert "numba.dynamic.globals" not in library.overloads[(types.float64,)].library.get_llvm_str()
    assert cpu_target.target_context.get_constant_generic(None, numba.typeof(inner), inner) is not None
