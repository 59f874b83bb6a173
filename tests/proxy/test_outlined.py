"""Outlined kernels: compiled once, cached separately and called by address."""

import re
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numba
import pytest
from helpers.compiled_code import called_in, functions
from helpers.programs import run_program

from softfinger.proxy.kernels.jit import decorators, outlined
from softfinger.proxy.kernels.jit.compiler.numba_internals import UNIT_PREFIX, code_of

MODULE = """
from typing import NamedTuple

from softfinger.proxy.kernels.jit.decorators import entry, jit
from softfinger.proxy.kernels.jit.outlined import outlined

FACTOR = 2.0

class Found(NamedTuple):
    size: float
    large: bool
    number: int
    place: tuple[float, float, float]

@jit
def scaled(x):
    return FACTOR * x

@outlined
def found(x: float, place: tuple[float, float, float], number: int) -> Found:
    return Found(scaled(x), x > 2.5, number + 1, (place[0], place[1] * x, place[2]))

@outlined
def twice(x: float) -> float:
    return 2.0 * found(x, (x, x, x), 7).place[1]
"""
FIRST = """
from both import entry, found, twice
@entry
def first(x):
    one = found(x, (1.0, 2.0, 3.0), 4)
    return one.size, one.large, one.number, one.place, twice(x)
print(first(3.0), sum(first.stats.cache_hits.values()), len(found(1.0, (0.0, 0.0, 0.0), 1)))
"""
SECOND = FIRST.replace("first", "second").replace("def second(x):", "def second(x):\n    x = x + 0.0")
RESULT = "(6.0, True, 5, (1.0, 6.0, 3.0), 18.0)"


@pytest.fixture
def scripts(tmp_path: Path) -> Path:
    folder = tmp_path / "scripts"
    folder.mkdir()
    for name, text in {"both": MODULE, "first": FIRST, "second": SECOND}.items():
        (folder / f"{name}.py").write_text(text)
    return folder


def run(script: Path, cache: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("SOFTFINGER_CACHE_DIR", str(cache))
    process = run_program([sys.executable, "-B", script])
    assert process.returncode == 0 and process.stderr == "", process.stderr
    return process.stdout.strip()


def units(cache: Path) -> dict[str, int]:
    return {path.name: path.stat().st_mtime_ns for path in cache.rglob(f"{UNIT_PREFIX}*.kernel")}


def test_outlined_kernels_are_compiled_once_for_all_callers(scripts, tmp_path, monkeypatch):
    """A missing symbol would end the program: callers are recompiled with a kernel whose file is missing."""
    cache = tmp_path / "cache"
    assert run(scripts / "first.py", cache, monkeypatch) == f"{RESULT} 0 4"
    files = units(cache)
    assert len(files) == 2
    assert run(scripts / "second.py", cache, monkeypatch) == f"{RESULT} 0 4" and units(cache) == files
    for path in cache.rglob(f"{UNIT_PREFIX}found*.kernel"):
        path.unlink()
    assert run(scripts / "first.py", cache, monkeypatch) == f"{RESULT} 0 4"
    assert run(scripts / "first.py", cache, monkeypatch) == f"{RESULT} 1 4"


def test_plain_python_gives_the_same(scripts: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_DISABLE_JIT", "1")
    script = scripts / "first.py"
    script.write_text(FIRST.replace(", sum(first.stats.cache_hits.values())", ""))
    assert run(script, tmp_path / "cache", monkeypatch) == f"{RESULT} 4"


def test_a_caller_contains_a_call_and_not_the_code() -> None:
    """The caller's module refers to the kernel's symbol; the kernel has its own module without an allocator."""

    @decorators.jit
    def lowest(x: float) -> float:
        return x * x

    @outlined.outlined
    def large(x: float) -> float:
        return lowest(x) + 1.0

    outermost: Any = numba.njit(**decorators.OPTIONS)(lambda x: large(x) * large(x + 1.0))
    assert outermost(1.0) == 10.0  # whole numbers: exact
    (ir,) = outermost.inspect_llvm().values()
    bodies = functions(ir)
    (symbol,) = {name for body in bodies.values() for name in called_in(body) if name.startswith(UNIT_PREFIX)}
    assert len(bodies) == 1 and sum(called_in(body)[symbol] for body in bodies.values()) == 2
    code = code_of(symbol)
    assert not re.search("NRT|malloc|PyGILState", code) and "fmul" in code


def test_outlined_kernels_return_only_numbers() -> None:
    @outlined.outlined
    def named(x: float) -> str:
        return "x"

    outermost: Any = numba.njit(**decorators.OPTIONS)(lambda x: named(x))
    with pytest.raises(TypeError, match="outlined kernel returns numbers"):
        outermost(1.0)


class Pair(NamedTuple):
    first: float
    rest: Any


def test_an_annotation_without_a_type_is_inferred() -> None:
    @outlined.outlined
    def swapped(pair: Pair) -> tuple[Pair, float]:
        return Pair(pair.first + 1.0, pair.rest), pair.first

    outermost: Any = numba.njit(**decorators.OPTIONS)(lambda pair: swapped(pair))
    assert outermost(Pair(1.0, (2.0, None))) == (Pair(2.0, (2.0, None)), 1.0)
    assert all(UNIT_PREFIX in code for code in outermost.inspect_llvm().values())


def test_where_selects_the_outlined_types() -> None:
    @outlined.outlined_where(lambda *arguments: arguments[0] == numba.types.float64)
    def halved(x: float) -> float:
        return x / 2

    outermost: Any = numba.njit(**decorators.OPTIONS)(lambda x: halved(x))
    assert outermost(3.0) == outermost(3) == 1.5
    by_address = [UNIT_PREFIX in code for code in outermost.inspect_llvm().values()]
    assert sorted(by_address) == [False, True]
