"""Unused parts of a scene are absent from its compiled code, also if other scenes could use them.

These tests compile in every run, because they inspect compiler output, which is not cached. `make test` therefore
compiles only the bare plane, `make test-all` every scene.
"""

from __future__ import annotations

import functools
import json
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

import numba
import pytest
from helpers.compiled_code import Compiled, compile_step
from helpers.programs import run_program

from softfinger.config import schema
from softfinger.config.load import build
from softfinger.proxy.scene import build_scene
from softfinger.tools.bench.features import RIBS, iter_features

FRICTION = {"friction": {"static": 0.6, "kinetic": 0.5}}
TORSION = {"torsion": {"stiffness_nm_per_rad": 0.05, "friction_length_m": 0.004}}

STAND_INS = {
    "contact.fingertip.compute_arm",
    "contact.fingertip.minkowski_objects",
    "contact.fingertip.find_finger_point",
    "contact.fingertip.find_contact_point",
    "contact.fingertip.compute_radius_of_curvature",
    "contact.fingertip.compute_torque",
    "contact.fingertip.add_surface_velocity",
    "contact.normal.compute_normal_force",
    "contact.normal.compute_spring_force",
    "contact.normal.compute_elastic_force",
    "contact.normal.bound_force",
    "friction.contact_patch.compute_contact_patch",
    "friction.contact_patch.adapt_torsion",
    "friction.contact_patch.adapt_spring",
    "friction.contact_patch.compute_winding_unit",
    "friction.torsion.find_spring",
    "friction.stick_slip.stick_slip",
    "friction.stick_slip.slide_freely",
    "friction.laws.rotate_law",
    "friction.torsion.wind_up",
    "friction.torsion.scale_stiffness",
    "friction.torsion.scale_stiffness_of_spring",
    "contact.rolling.base.project_without_roll",
    "contact.rolling.base.land_from",
    "contact.rolling.on_objects.can_follow",
    "contact.rolling.on_objects.roll_on",
    "shapes.composite.shade_normal",
    "effects.forces.apply_effects",
    "effects.objects.apply_objects_effects",
    "query.motion.compute_pose",
    "friction.torsion.damp_moment",
    "query.motion.can_move",
    "query.motion.select_moving_pose",
    "shapes.protocol.is_hollow",
    "shapes.composite.nearest_of_shape",
    "shapes.protocol.meets",
    "shapes.composite.raised_clear",
    "shapes.protocol.closest_from",
    "shapes.protocol.closest_within",
    "shapes.protocol.follows",
    "shapes.plane.closest_on_plane",
    "shapes.plane.transport_on_plane",
    "shapes.plane.travel_to_plane",
    "contact.texture.apply_grip",
    "contact.texture.apply_relief",
}
"""All kernels of the modules below that a bare plane compiles: those for absent parts, and those of the plane."""

PARTS = (
    "contact.fingertip",
    "friction",
    "contact.normal",
    "contact.rolling",
    "effects",
    "query.motion",
    "shapes",
    "contact.texture",
)

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


def of_modules(kernels: set[str], modules: tuple[str, ...]) -> set[str]:
    return {kernel for kernel in kernels if kernel.startswith(tuple(f"{module}." for module in modules))}


def test_bare_plane_has_no_kernel_of_absent_parts() -> None:
    """Of friction, torsion, rolling, effects, motion and geometry it has only the kernels for absent parts, and the
    plane."""
    assert of_modules(compiled("bare").kernels, PARTS) == STAND_INS


def test_bare_plane_has_no_costly_instruction() -> None:
    bare = compiled("bare")
    # The root gives the magnitude of the tangential force, which is in every record.
    assert set(bare.calls) <= {"llvm.sqrt.f64"} and bare.calls["llvm.sqrt.f64"] <= 1
    # Velocity filter; fraction of the sweep; easing of the load.
    assert bare.operations["fdiv"] <= 3


@pytest.mark.exhaustive
@pytest.mark.parametrize(("without", "having"), ADDED)
def test_each_feature_adds_code_only_to_scenes_with_it(without: str, having: str) -> None:
    less, more = compiled(without), compiled(having)
    added = more.kernels - less.kernels
    assert {kernel.rpartition(".")[0] for kernel in added} >= ADDED[without, having]
    assert less.arithmetic < more.arithmetic
    assert sum(less.operations.values()) < sum(more.operations.values())


CALLED: dict[str, tuple[set[str], set[str] | None]] = {
    "bare": (set(), {"sqrt"}),
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


@pytest.mark.parametrize(
    "name", ["bare", *(pytest.param(name, marks=pytest.mark.exhaustive) for name in CALLED if name != "bare")]
)
def test_costly_functions_are_called_by_the_parts_that_need_them(name: str) -> None:
    """atan2 is called only with rolling and torsion, sin with an oscillation or a turntable, pow with a nonlinear
    normal force."""
    called = {call.removeprefix("llvm.").removesuffix(".f64") for call in compiled(name).calls}
    least, most = CALLED[name]
    assert least <= called and (most is None or called <= most)


REGISTER = """
import sys
import numba
from typing import NamedTuple
from softfinger.proxy.kernels.shapes import closest, curvature
from softfinger.proxy.kernels.shapes.protocol import any_tangent

class Step(NamedTuple):
    "Half space z <= height: a plane again, but as a type of its own."
    height: float

@closest.of(Step)
def closest_on_step(shape, x):
    return x[2] - shape.height, (x[0], x[1], shape.height), (0.0, 0.0, 1.0)

@curvature.of(Step)
def curvature_of_step(shape, radius, point, normal):
    return 0.0, 0.0, any_tangent(normal)
"""

COMPILE = """
import json
from helpers.compiled_code import compile_step
from softfinger.proxy.scene import build_scene
from test_economy import scene

def report(step):
    return {"body": step.body, "kernels": sorted(step.kernels)}

found = {name: report(compile_step(build_scene(scene(name)))) for name in %r}
"""

USE = """
from softfinger.proxy.kernels.model import Single
bare = build_scene(scene("bare"))
found["new"] = report(compile_step(bare._replace(objects=Single(bare.objects.body._replace(shape=Step(0.0))))))
"""


def in_a_process(*code: str) -> dict[str, dict[str, Any]]:
    path = os.pathsep.join([str(Path(__file__).parents[1]), *sys.path])
    environment = os.environ | {"PYTHONPATH": path, "PYTHONHASHSEED": "12345"}
    script = "\n".join([*code, "print(json.dumps(found))"])
    process = run_program([sys.executable, "-c", script], env=environment, check=True)
    reports: dict[str, dict[str, Any]] = json.loads(process.stdout)
    return reports


@pytest.mark.exhaustive
def test_an_unused_surface_does_not_change_compiled_code() -> None:
    names = ["bare", "whole"]
    reports = in_a_process(REGISTER, COMPILE % names, USE)
    for name in names:
        assert reports[name]["body"] == compiled(name).body
        assert set(reports[name]["kernels"]) == compiled(name).kernels
    # The comparison is sensitive to a part, and the surface was registered: a scene that uses it contains its kernel.
    bodies = [reports[name]["body"] for name in reports] + [compiled("friction").body, compiled("second object").body]
    assert len(set(bodies)) == len(bodies)
    assert "rest_on_curved" in {kernel.split(".")[-1] for kernel in reports["new"]["kernels"]}


def test_table_of_features_has_every_feature_of_the_scene_format() -> None:
    pairs = [(feature.without, feature.having) for feature in iter_features()]

    def news(of: Callable[[schema.Scene], set[str]]) -> set[str]:
        return set().union(*(of(having) - of(without) for without, having in pairs))

    def kinds(union: Any, key: str = "kind") -> set[str]:
        return {getattr(member, key) for member in get_args(union)}

    assert news(lambda s: {s.rolling.method} if s.rolling else set()) == set(get_args(schema.RollingMethod))
    machines = news(lambda s: {s.rolling.state_machine} if s.rolling else set())
    assert machines == set(get_args(schema.StateMachine))
    options = {key for key in schema.Friction.__struct_fields__ if key not in {"static", "kinetic"}}

    def friction_keys(s: schema.Scene) -> set[str]:
        present = [t.material.friction for t in s.object if t.material.friction]
        return {key for friction in present for key in options if getattr(friction, key) is not None}

    # Static friction may also depend on direction: the same code with other numbers.
    assert news(friction_keys) == options - {"static_scale"}
    assert news(lambda s: {t.material.torsion.model for t in s.object if t.material.torsion}) == set(
        get_args(schema.TorsionModel)
    )
    assert news(lambda s: {effect.kind for effect in s.effect}) == kinds(schema.Effect)
    assert news(lambda s: {effect.kind for t in s.object for effect in t.effect}) == kinds(schema.ObjectEffect)
    # The cost of a body depends on its model.
    assert news(lambda s: {t.motion.kind for t in s.object if t.motion}) == kinds(schema.Motion) - {"body"}
    both = {"height_m", "friction_scale"}
    textures = news(
        lambda s: {key for t in s.object for key in both if getattr(getattr(t, "texture", None), key, None)}
    )
    assert textures == both
    # The plane is the reference of the comparison, and the cost of a mesh depends on its file.
    shapes = kinds(schema.Object, "shape") - {"plane", "mesh"}
    assert news(lambda s: {t.shape for t in s.object}) >= shapes
    hollow = shapes - {"heightmap"}  # a height map has no inside
    assert news(lambda s: {t.shape for t in s.object if getattr(t, "inside", False)}) == hollow


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
