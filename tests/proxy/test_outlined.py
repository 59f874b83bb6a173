"""Outlined kernels, compiled once and called by address; unused parts of a scene, absent from its compiled code.

Compiler output is not cached, so each run compiles: `make test` the bare plane, `make test-all` every scene.
"""

import functools
import re
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numba
import pytest
from helpers.compiled_code import Compiled, called_in, compile_step, functions
from helpers.programs import run_program

from softfinger.config import schema
from softfinger.config.load import build
from softfinger.proxy.kernels.jit import decorators, outlined
from softfinger.proxy.kernels.jit.compiler.numba_internals import UNIT_PREFIX, code_of
from softfinger.proxy.scene import build_scene
from softfinger.tools.bench.features import RIBS, iter_features

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
print(first(3.0), sum(first.stats.cache_hits.values()))
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
    """A missing symbol would end the program: callers are recompiled if the file of a kernel is missing."""
    cache = tmp_path / "cache"
    assert run(scripts / "first.py", cache, monkeypatch) == f"{RESULT} 0"
    files = units(cache)
    assert len(files) == 2
    assert run(scripts / "second.py", cache, monkeypatch) == f"{RESULT} 0" and units(cache) == files
    for path in cache.rglob(f"{UNIT_PREFIX}found*.kernel"):
        path.unlink()
    assert run(scripts / "first.py", cache, monkeypatch) == f"{RESULT} 0"
    assert run(scripts / "first.py", cache, monkeypatch) == f"{RESULT} 1"


def test_a_caller_contains_a_call_and_not_the_code() -> None:
    """The caller's module refers to the kernel's symbol; the kernel has its own module without an allocator."""

    @decorators.jit
    def lowest(x: float) -> float:
        return x * x

    @outlined.outlined
    def large(x: float) -> float:
        return lowest(x) + 1.0

    outermost: Any = numba.njit(**decorators.OPTIONS)(lambda x: large(x) * large(x + 1.0))
    assert outermost(1.0) == 10.0  # integers: exact
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


FRICTION = {"friction": {"static": 0.6, "kinetic": 0.5}}
TORSION = {"torsion": {"stiffness_nm_per_rad": 0.05, "friction_length_m": 0.004}}

SCENES: dict[str, dict[str, Any]] = {
    "bare": {},
    "bent": {"material": {"normal": {"exponent": 1.5}}},
    "crossed": {"material": {"normal": {"damping_s_per_m": 0.5}}},
    "friction": {"material": FRICTION},
    "rolling": {"material": FRICTION, "rolling": {"method": "euler_zxz"}},
    "whole": {"material": FRICTION | TORSION, "rolling": {"method": "euler_zxz"}},
    "patch": {"material": FRICTION | TORSION, "fingertip": {"patch": {"shear_modulus_pa": 45e3}}},
    "form": {"fingertip": {"radius_m": None, "radii_m": [0.008, 0.006, 0.012]}},
    "effect": {"effect": [{"kind": "vibration", "amplitude_n": 1.0, "frequency_hz": 50.0, "direction": [0, 0, 1]}]},
    "motion": {"motion": {"kind": "turntable", "rate_rad_per_s": 1.0}},
    "texture": {"texture": {"file": str(RIBS), "size_m": [0.004, 0.004], "height_m": 1e-4}},
    "second object": {"others": [{"name": "ball", "shape": "sphere", "radius_m": 0.02}]},
}
"""A plane, with additional parts in each scene."""

ADDED = {
    ("bare", "bent"): set(),  # the same kernels, with other branches
    ("bare", "crossed"): set(),
    ("bare", "friction"): {"friction.stick_slip", "friction.laws", "friction.limit_surface"},
    ("friction", "rolling"): {"contact.rolling.euler", "numerics.rotations"},
    ("rolling", "whole"): {"friction.torsion"},
    ("friction", "patch"): {"friction.contact_patch"},
    ("bare", "form"): {"shapes.minkowski"},
    ("bare", "effect"): {"effects.forces"},
    ("bare", "motion"): {"query.motion"},
    ("bare", "texture"): {"contact.texture", "shapes.charts"},
    ("bare", "second object"): {"contact.rest.active_set", "shapes.any_shape"},
}
"""Pairs of scenes that differ by one part, and modules of which the first has fewer kernels."""


def scene(name: str) -> schema.Scene:
    changes = SCENES[name]
    stuff = {"material": {"stiffness_n_per_m": 1000.0} | changes.get("material", {})}
    table = {"name": "table", "shape": "plane"} | stuff
    table |= {key: changes[key] for key in ("motion", "texture") if key in changes}
    tables = {key: changes[key] for key in ("rolling", "effect") if key in changes}
    tables["fingertip"] = {"radius_m": 0.01} | changes.get("fingertip", {})
    objects = [table, *(entry | stuff for entry in changes.get("others", []))]
    return build(schema.Scene, {"object": objects, **tables}, name)


@functools.cache
def compiled(name: str) -> Compiled:
    return compile_step(build_scene(scene(name)))


def test_bare_plane_has_no_costly_instruction() -> None:
    bare = compiled("bare")
    # The root gives the magnitude of the tangential force, which is in every record.
    assert bare.calls.keys() <= {"llvm.sqrt.f64"} and bare.calls["llvm.sqrt.f64"] <= 1
    # Velocity filter; fraction of the sweep; easing of the load.
    assert bare.operations["fdiv"] <= 3


@pytest.mark.exhaustive
@pytest.mark.parametrize(("without", "having"), ADDED)
def test_each_feature_adds_code_only_to_scenes_with_it(without: str, having: str) -> None:
    less, more = compiled(without), compiled(having)
    added = more.kernels - less.kernels
    assert {kernel.rpartition(".")[0] for kernel in added} >= ADDED[without, having]
    assert less.arithmetic < more.arithmetic and sum(less.operations.values()) < sum(more.operations.values())


CALLED: dict[str, tuple[set[str], set[str] | None]] = {
    "bent": ({"pow"}, {"sqrt", "pow"}),
    "crossed": (set(), {"sqrt"}),
    "friction": (set(), {"sqrt"}),
    "rolling": ({"atan2"}, None),
    "whole": ({"atan2"}, None),
    "effect": ({"sin"}, None),
    "motion": ({"sin", "cos"}, None),
    "texture": (set(), {"sqrt", "floor"}),  # floor is one instruction
}
"""Functions that each scene calls at least and, if known, at most."""


@pytest.mark.exhaustive
@pytest.mark.parametrize("name", CALLED)
def test_costly_functions_are_called_by_the_parts_that_need_them(name: str) -> None:
    called = {call.removeprefix("llvm.").removesuffix(".f64") for call in compiled(name).calls}
    least, most = CALLED[name]
    assert least <= called and (most is None or called <= most)


def test_pairs_of_features_differ_in_compiled_types() -> None:
    """Features are code, not numbers; both sides of a smooth shape share code, and so do two and three objects."""
    names = [feature.name for feature in iter_features()]
    assert len(set(names)) == len(names)
    for feature in iter_features():
        types = {numba.typeof(build_scene(s)) for s in (feature.without, feature.having)}
        name = feature.name
        one_code = name.startswith("inside ") and "ends" not in name and "box" not in name
        one_code |= name.startswith("third object")
        assert len(types) == (1 if one_code else 2), feature.name
