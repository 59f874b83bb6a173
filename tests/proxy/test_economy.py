"""Unused parts of a scene are absent from its compiled code. Compiler output is not cached, so these tests compile in
every run: `make test` the bare plane, `make test-all` every scene."""

import functools
from typing import Any

import numba
import pytest
from helpers.compiled_code import Compiled, compile_step

from softfinger.config import schema
from softfinger.config.load import build
from softfinger.proxy.scene import build_scene
from softfinger.tools.bench.features import RIBS, iter_features

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
