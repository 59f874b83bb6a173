"""Effects: forces compared with closed forms, bounds, energy, scene file and rendering."""

import math
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import numba
import numpy as np
import pytest
from conftest import paper_scene
from helpers.examples import examples
from helpers.touching import posed
from hypothesis import given
from hypothesis import strategies as st
from references.hand import Array, plane_engine

from softfinger.config import schema
from softfinger.config.load import build
from softfinger.config.schema import Scene
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.effects.forces import FORCE_CEILING_N, Situation, apply_effects, start_states
from softfinger.proxy.kernels.jit.decorators import OPTIONS
from softfinger.proxy.kernels.jit.pack import flatten
from softfinger.proxy.scene import build_scene

pytestmark = pytest.mark.plain

ZERO, UP = (0.0, 0.0, 0.0), (0.0, 0.0, 1.0)
DT = 0.001
BOX = model.BoxRegion(ZERO, (0.1, 0.2, 0.3), 0.0)
BALL = model.SphereRegion((0.01, 0.0, 0.0), 0.05, 0.01)
CARRIER = model.Pose((0.1, -0.2, 0.3), (0.5, 0.5, -0.5, 0.5))

EVERY = (
    model.Viscosity(2.0, None),
    model.Viscosity(3.0, BOX),
    model.ConstantForce((0.5, -1.0, 2.0), BALL),
    model.Spring((0.0, 0.0, 0.1), 100.0, 0.02, 2.0, None),
    model.BoxBoundary(ZERO, (0.1, 0.1, 0.1), 500.0, 3.0, 5.0),
    model.SphereBoundary((0.0, 0.0, 0.1), 0.05, 500.0, 3.0, 5.0),
    model.Vibration(0.5, 80.0, UP, BOX),
    model.Vibration(0.5, 80.0, UP, model.TouchCondition(1.0)),
    model.NormalVibration(0.4, 33.0),
    model.Magnet(2.0, 0.02, 1.5),
    model.StickSlip(800.0, 0.6),
)
"""One effect of every kind; together they compile every kernel."""


def moment(position: model.Vec3 = ZERO, velocity: model.Vec3 = ZERO, **changes: Any) -> Situation:
    """Return the situation of a tick of 1 ms, by default out of contact and far from all objects."""
    return Situation(position, velocity, DT, 0.0, 1.0, UP, None)._replace(**changes)


def force_of(effect: Any, at: Situation) -> Array:
    return np.array(apply_effects((effect,), start_states((effect,)), at)[0])


def run(effect: Any, moments: Iterator[Situation]) -> Array:
    states, forces = start_states((effect,)), []
    for at in moments:
        force, states = apply_effects((effect,), states, at)
        forces.append(force)
    return np.array(forces)


@pytest.fixture(scope="module")
def compiled() -> Any:
    return numba.njit(**OPTIONS)(lambda effects, states, at: apply_effects(effects, states, at))


finite = st.floats(allow_nan=False, allow_infinity=False)
near = st.floats(-1.0, 1.0)
places = st.tuples(near, near, near)
anywhere = st.tuples(finite, finite, finite)


@st.composite
def normals(draw: st.DrawFn) -> model.Vec3:
    z, angle = draw(st.floats(-1.0, 1.0)), draw(st.floats(0.0, 2 * math.pi))
    s = math.sqrt(1.0 - z * z)
    return (s * math.cos(angle), s * math.sin(angle), z)


def test_viscosity_opposes_the_velocity_inside_its_region_only() -> None:
    v = (0.1, -0.2, 0.3)
    assert force_of(model.Viscosity(2.0, None), moment((9.0, 9.0, 9.0), v)) == pytest.approx([-0.2, 0.4, -0.6])
    assert force_of(model.Viscosity(2.0, BOX), moment((0.09, -0.19, 0.29), v)) == pytest.approx([-0.2, 0.4, -0.6])
    for outside in [(0.11, 0.0, 0.0), (0.0, -0.21, 0.0), (0.0, 0.0, 0.31)]:
        assert not force_of(model.Viscosity(2.0, BOX), moment(outside, v)).any()


@examples(100, 500)
@given(places, anywhere, st.sampled_from([None, BOX, BALL, model.TouchCondition(1.0)]), st.sampled_from([0.0, 1.0]))
def test_viscosity_never_adds_energy(x: model.Vec3, v: model.Vec3, region: Any, touched: float) -> None:
    force, _ = apply_effects((model.Viscosity(2.0, region),), (None,), moment(x, v, touched=touched))
    # By component, since the sum may overflow.
    assert all(f == 0.0 or (f < 0.0) == (c > 0.0) for f, c in zip(force, v, strict=True))


def test_a_soft_edge_fades_the_effect_in() -> None:
    effect = model.ConstantForce((0.0, 0.0, -4.0), model.SphereRegion(ZERO, 0.05, 0.01))
    depths = {-0.001: 0.0, 0.0: 0.0, 0.0025: 0.25, 0.005: 0.5, 0.01: 1.0, 0.05: 1.0}
    for depth, share in depths.items():
        assert force_of(effect, moment((0.0, 0.05 - depth, 0.0))) == pytest.approx([0.0, 0.0, -4.0 * share], abs=1e-12)


@pytest.mark.parametrize(("distance", "expected"), [(0.05, -3.0), (0.02, 0.0), (0.015, 0.5), (0.2, -4.0), (0.0, 0.0)])
def test_spring_pulls_beyond_its_rest_length_and_pushes_within(distance: float, expected: float) -> None:
    """The force is K (rest - d) along the line from the anchor, up to its limit, and zero at the anchor."""
    anchor, along = np.array([0.01, -0.02, 0.03]), np.array([2.0, -1.0, 2.0]) / 3.0
    x, y, z = anchor + distance * along
    effect = model.Spring((0.01, -0.02, 0.03), 100.0, 0.02, 4.0, None)
    assert force_of(effect, moment((x, y, z))) == pytest.approx(expected * along, abs=1e-12)


boundaries = pytest.mark.parametrize(
    "effect",
    [
        model.BoxBoundary((0.1, 0.0, 0.0), (0.05, 0.06, 0.07), 400.0, 5.0, 6.0),
        model.SphereBoundary((0.1, 0.0, 0.0), 0.06, 400.0, 5.0, 6.0),
    ],
)


@pytest.mark.parametrize(
    ("x", "v", "expected"),
    [
        ((0.16, 0.05, 0.0), ZERO, (-4.0, 0.0, 0.0)),
        ((0.16, 0.05, 0.0), (0.2, 9.0, 0.0), (-5.0, 0.0, 0.0)),
        ((0.16, 0.05, 0.0), (2.0, 0.0, 0.0), (-6.0, 0.0, 0.0)),
        ((0.16, 0.05, 0.0), (-2.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ((0.153, 0.064, 0.0), ZERO, (-1.2, -1.6, 0.0)),
        ((0.1499, 0.0, 0.0), (9.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    ],
)
def test_box_boundary_is_a_spring_and_damper(x: model.Vec3, v: model.Vec3, expected: model.Vec3) -> None:
    effect = model.BoxBoundary((0.1, 0.0, 0.0), (0.05, 0.06, 0.07), 400.0, 5.0, 6.0)
    assert force_of(effect, moment(x, v)) == pytest.approx(expected, abs=1e-12)


@boundaries
@examples(100, 300)
@given(x=places, v=places)
def test_boundary_pushes_inward(effect: Any, x: model.Vec3, v: model.Vec3) -> None:
    force = force_of(effect, moment(x, v))
    away = np.array(x) - effect.center
    size = np.linalg.norm(force)
    assert size <= effect.force_max * (1 + 1e-12)
    if isinstance(effect, model.BoxBoundary):
        outward = away - np.clip(away, -np.array(effect.half_extents), effect.half_extents)
    else:
        outward = away * max(0.0, 1.0 - effect.radius / max(float(np.linalg.norm(away)), 1e-300))
    depth = np.linalg.norm(outward)
    if depth == 0.0:
        assert size == 0.0
    elif depth > 1e-9:  # closer, the difference of two positions of 0.1 m has no significant direction
        assert force @ outward == pytest.approx(-size * depth, abs=1e-6)
    assert size <= 2 * effect.stiffness * depth + 1e-9


@pytest.mark.parametrize("exponent", [1.0, 2.0, 3.5])
def test_magnet_vanishes_at_its_range_without_a_step(exponent: float) -> None:
    """The pull is F (1 - gap / range)^n towards the surface, and F in contact."""
    effect = model.Magnet(2.0, 0.02, exponent)
    normal = (0.6, 0.0, 0.8)
    for gap in [0.0, 0.004, 0.01, 0.019]:
        pull = 2.0 * (1.0 - gap / 0.02) ** exponent
        assert force_of(effect, moment(gap=gap, normal=normal)) == pytest.approx(-pull * np.array(normal), abs=1e-12)
    assert np.linalg.norm(force_of(effect, moment(gap=0.02 * (1 - 1e-9)))) <= 2.1e-9
    assert not force_of(effect, moment(gap=0.02)).any()
    assert force_of(effect, moment(gap=1.0, touched=1.0)) == pytest.approx([0.0, 0.0, -2.0])
    assert force_of(effect, moment(gap=-0.001)) == pytest.approx(force_of(effect, moment(gap=1e-15)), abs=1e-9)


def test_magnet_does_the_work_of_its_potential() -> None:
    """From its range to the surface the magnet does the work F range / (n + 1), also along a spiral."""
    effect = model.Magnet(2.0, 0.02, 2.0)
    # Spiral towards the sphere |x| = 1: the gap is |x| - 1, the normal x / |x|.
    s = np.linspace(0.0, 1.0, 4001)
    radius, angle = 1.03 - 0.03 * s, 2.0 * s
    path = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.0 * s], axis=1)
    middle = 0.5 * (path[1:] + path[:-1])
    lengths = np.linalg.norm(middle, axis=1)
    moments = [moment(gap=g - 1.0, normal=tuple(x / g)) for x, g in zip(middle, lengths, strict=True)]
    forces = np.array([force_of(effect, at) for at in moments])
    # Midpoint rule with 4000 steps: error about 1e-7 of the work.
    assert np.sum(forces * np.diff(path, axis=0)) == pytest.approx(2.0 * 0.02 / 3.0, rel=1e-5)


def test_an_ellipsoid_gains_energy_when_it_turns_near_a_magnet() -> None:
    """The ellipsoid descends with its long axis upright, rotates, rises with it level and rotates back. The magnet
    exerts no torque, so the cycle gains F (c - b) h / range (docs/model/effects.md)."""
    force, reach, b, c, low, high = 2.0, 0.02, 0.007, 0.012, 0.015, 0.019
    plane = {
        "name": "plane",
        "shape": "plane",
        "material": {"stiffness_n_per_m": 1000.0},
        "effect": [{"kind": "magnet", "force_n": force, "range_m": reach}],
    }
    running = Engine({"fingertip": {"radii_m": [0.008, b, c]}, "object": [plane]})
    ways, half = np.linspace(high, low, 201), np.linspace(0.0, 0.25 * np.pi, 201)
    heights = np.concatenate([ways, np.full(201, low), ways[::-1], np.full(201, high)])
    halves = np.concatenate([np.zeros(201), half, np.full(201, half[-1]), half[::-1]])
    nothing = 0.0 * heights
    places = np.stack([nothing, nothing, heights], axis=1)
    records = running.run(np.hstack([places, np.stack([np.cos(halves), np.sin(halves), nothing, nothing], axis=1)]))
    assert not records["torque"].any() and (records["contact.mode"] == 0).all()
    middle = 0.5 * (records["force"][1:] + records["force"][:-1])  # the pull is linear in the height: exact
    wanted = force * (c - b) / reach * (high - low)
    assert np.sum(middle * np.diff(places, axis=0)) == pytest.approx(wanted, rel=1e-9)  # rounding of 400 products


def drag(length: float, n: int, **changes: Any) -> Iterator[Situation]:
    for k in range(n + 1):
        yield moment((length * k / n, 0.0, 0.0), touched=1.0, **changes)


def test_stick_slip_is_a_sawtooth() -> None:
    forces = run(model.StickSlip(1000.0, 0.5), drag(0.005, 5000))
    # 0.5 N / 1000 N/m = 0.5 mm per ridge; it jumps on the first tick beyond it, a step of 1 um later.
    assert forces[:, 0].min() == pytest.approx(-0.5, abs=1e-9)
    jumps = np.flatnonzero(np.diff(forces[:, 0]) > 0.4)
    assert len(jumps) == 9 and np.diff(jumps) == pytest.approx(501, abs=1)
    assert not forces[:, 1:].any()
    work = np.sum(forces[:, 0]) * 1e-6
    # F^2 / 2K per ridge, ten ridges except nine steps lost on jumping; 0.3 % because of finite ticks.
    assert work == pytest.approx(-10 * 0.5**2 / 2000.0, rel=0.01)


def test_stick_slip_ignores_depth_and_resets_on_release() -> None:
    effect = model.StickSlip(1000.0, 0.5)
    pressed = moment((0.0001, 0.0, -0.002), touched=1.0)
    away = moment((0.2, 0.0, 0.1))
    forces = run(effect, iter([moment(touched=1.0), pressed, away, pressed, pressed]))
    assert forces == pytest.approx(np.array([ZERO, (-0.1, 0.0, 0.0), ZERO, ZERO, ZERO]), abs=1e-12)


def test_stick_slip_moves_with_its_object() -> None:
    effect = model.StickSlip(1000.0, 0.5)
    half = math.sqrt(0.5)
    before = model.Pose(ZERO, (1.0, 0.0, 0.0, 0.0))
    after = model.Pose((1.0, 0.0, 0.0), (half, 0.0, 0.0, half))
    touched = moment((0.1, 0.0, 0.0), touched=1.0, carrier=before)
    rides = moment((1.0, 0.1, 0.0), touched=1.0, carrier=after)
    assert run(effect, iter([touched, rides]))[1] == pytest.approx([0.0, 0.0, 0.0], abs=1e-10)
    lags = moment((1.0, 0.0997, 0.0), touched=1.0, carrier=after)
    assert run(effect, iter([touched, lags]))[1] == pytest.approx([0.0, 0.3, 0.0], abs=1e-9)


def test_vibration_is_a_sine_from_touch_on() -> None:
    """A sin(2 pi f t) along the normal, with t from the first tick of contact; zero before and after."""
    effect = model.NormalVibration(0.5, 130.0)
    normal = (0.0, 0.6, 0.8)
    moments = [moment(normal=normal, touched=float(100 <= k < 5100)) for k in range(5200)]
    forces = run(effect, iter(moments))
    sine = 0.5 * np.sin(2 * np.pi * 130.0 * DT * np.arange(5000))
    # The phase is accumulated: 5000 roundings of 1e-16 turns.
    assert forces[100:5100] == pytest.approx(np.outer(sine, normal), abs=1e-11) and not forces[:100].any()
    assert not forces[5100:].any()


@pytest.mark.parametrize(
    "effect", [model.NormalVibration(0.5, 130.0), model.Vibration(0.5, 130.0, UP, model.TouchCondition(1.0))]
)
def test_vibration_restarts_with_each_touch(effect: Any) -> None:
    touches = [1.0] * 3 + [0.0] + [1.0] * 3
    forces = run(effect, iter([moment(normal=UP, touched=touched) for touched in touches]))[:, 2]
    sine = 0.5 * np.sin(2 * np.pi * 130.0 * DT * np.arange(3))
    assert forces == pytest.approx([*sine, 0.0, *sine], abs=1e-15)


def test_vibration_keeps_its_phase_over_a_month() -> None:
    effect = model.Vibration(1.0, 250.0, UP, None)
    states: Any = (model.Phase(0.0),)
    for _ in range(1001):
        _, states = apply_effects((effect,), states, moment(dt=4000.0011))
    # Full turns in 4000 s cancel; 1001 times 250 Hz times 1.1 ms are 275.275 turns.
    assert states[0].turns == pytest.approx(0.275, abs=1e-6)


def test_a_change_of_frequency_keeps_the_force_continuous() -> None:
    slow, fast = model.Vibration(1.0, 10.0, UP, None), model.Vibration(1.0, 11.0, UP, None)
    states: Any = start_states((slow,))
    forces = []
    for k in range(10_020):
        force, states = apply_effects((slow if k < 10_000 else fast,), states, moment())
        forces.append(force[2])
    assert np.abs(np.diff(forces)).max() <= 2 * np.pi * 11.0 * DT


def test_forces_add_up_and_states_are_separate() -> None:
    at = moment((0.02, 0.13, 0.04), (0.3, 0.1, -0.2), touched=1.0, gap=0.0)
    total, states = apply_effects(EVERY, start_states(EVERY), at)
    assert total == pytest.approx(sum(force_of(effect, at) for effect in EVERY), abs=1e-12)
    assert [type(state) for state in states] == [type(state) for state in start_states(EVERY)]
    assert apply_effects((), (), at) == (ZERO, ())


@examples(60, 200)
@given(
    st.lists(st.tuples(places, places, st.sampled_from([0.0, 1.0]), st.floats(-0.01, 0.05), normals()), max_size=4),
    st.sampled_from([None, CARRIER]),
)
def test_compiled_equals_plain_python(compiled: Any, ticks: list[Any], carrier: Any) -> None:
    ours = theirs = start_states(EVERY)
    for x, v, touched, gap, normal in ticks:
        at = Situation(x, v, DT, touched, gap, normal, carrier)
        force, ours = compiled(EVERY, ours, at)
        plain, theirs = apply_effects(EVERY, theirs, at)
        # pow and sin may come from another library than Python's: a few units in the last place of 10 N.
        assert force == pytest.approx(plain, abs=1e-13)
        for after, expected in zip(ours, theirs, strict=True):
            assert (after is None) == (expected is None)
            if after is not None:
                assert flatten(after) == pytest.approx(flatten(expected), abs=1e-15)


@pytest.mark.scaled
@examples(100, 1000)
@given(
    st.lists(st.tuples(anywhere, anywhere, finite.map(abs), st.booleans(), finite, normals()), min_size=1, max_size=3),
    st.sampled_from([None, CARRIER]),
)
def test_finite_input_gives_a_finite_force(compiled: Any, ticks: list[Any], carrier: Any) -> None:
    states = start_states(EVERY)
    for x, v, dt, touched, gap, normal in ticks:
        force, states = compiled(EVERY, states, Situation(x, v, dt, float(touched), gap, normal, carrier))
        assert all(abs(f) <= len(EVERY) * FORCE_CEILING_N for f in force)
    calm, _ = compiled(EVERY, states, Situation(ZERO, ZERO, DT, 0.0, 1.0, UP, carrier))
    assert all(math.isfinite(f) for f in calm)


WORKSPACE: list[dict[str, Any]] = [
    {"kind": "viscosity", "damping_ns_per_m": 2, "region": {"radius_m": 0.05, "edge_m": 0.01}},
    {"kind": "constant_force", "force_n": [0, 0, -1]},
    {"kind": "spring", "position_m": [0, 0, 0.1], "stiffness_n_per_m": 50, "force_max_n": 2},
    {
        "kind": "vibration",
        "amplitude_n": 0.5,
        "frequency_hz": 60,
        "direction": [0, 3, 4],
        "region": {"position_m": [0, 0, 1], "size_m": [0.2, 0.4, 0.6]},
    },
    {"kind": "boundary", "size_m": [0.2, 0.2, 0.4], "stiffness_n_per_m": 300, "damping_ns_per_m": 2, "force_max_n": 5},
    {"kind": "boundary", "radius_m": 0.2, "stiffness_n_per_m": 300, "force_max_n": 5},
]
OBJECT: list[dict[str, Any]] = [
    {"kind": "viscosity", "damping_ns_per_m": 2},
    {"kind": "constant_force", "force_n": [1, 0, 0]},
    {"kind": "vibration", "amplitude_n": 0.5, "frequency_hz": 60},
    {"kind": "vibration", "amplitude_n": 0.5, "frequency_hz": 60, "direction": [2, 0, 0]},
    {"kind": "magnet", "force_n": 2, "range_m": 0.02},
    {"kind": "stick_slip", "stiffness_n_per_m": 800, "force_max_n": 0.5},
]


def test_every_kind_in_a_file_becomes_its_kernel() -> None:
    scene = build_scene(paper_scene(table={"effect": OBJECT}, effect=WORKSPACE))
    touching = model.TouchCondition(1.0)
    assert scene.effects == (
        model.Viscosity(2.0, model.SphereRegion(ZERO, 0.05, 0.01)),
        model.ConstantForce((0.0, 0.0, -1.0), None),
        model.Spring((0.0, 0.0, 0.1), 50.0, 0.0, 2.0, None),
        model.Vibration(0.5, 60.0, (0.0, 0.6, 0.8), model.BoxRegion((0.0, 0.0, 1.0), (0.1, 0.2, 0.3), 0.0)),
        model.BoxBoundary(ZERO, (0.1, 0.1, 0.2), 300.0, 2.0, 5.0),
        model.SphereBoundary(ZERO, 0.2, 300.0, 0.0, 5.0),
    )
    assert scene.objects.effects[0].effects == (
        model.Viscosity(2.0, touching),
        model.ConstantForce((1.0, 0.0, 0.0), touching),
        model.NormalVibration(0.5, 60.0),
        model.Vibration(0.5, 60.0, (1.0, 0.0, 0.0), touching),
        model.Magnet(2.0, 0.02, 1.0),
        model.StickSlip(800.0, 0.5),
    )


def page() -> str:
    return (Path(__file__).resolve().parents[2] / "docs" / "model" / "effects.md").read_text()


def test_the_example_of_the_page_is_a_scene() -> None:
    (example,) = re.findall(r"```toml\n(.*?)```", page(), re.DOTALL)
    scene = build(Scene, tomllib.loads(example), "docs/model/effects.md")
    kernels = build_scene(scene)
    assert [type(effect) for effect in kernels.effects] == [model.Viscosity, model.SphereBoundary]
    assert [type(effect) for effect in kernels.objects.effects[0].effects] == [model.Magnet]
    assert kernels.objects.body.motion == model.NO_MOTION._replace(kind=model.TURNTABLE, axis=UP, rate=0.5)
    assert scene.object[0].material.name == "rubber"


def test_the_page_names_every_kind() -> None:
    kinds = [kind for union in (schema.Effect, schema.ObjectEffect, schema.Motion) for kind in get_args(union)]
    for kind in kinds:
        assert f"`{kind.kind}`" in page()


def test_effects_are_added_to_the_contact_force() -> None:
    magnet = {"kind": "magnet", "force_n": 2.0, "range_m": 0.02}
    film = {"kind": "viscosity", "damping_ns_per_m": 4.0, "region": {"size_m": [1.0, 1.0, 1.0]}}
    z = np.linspace(0.04, 0.008, 321)
    path = np.stack([0.0 * z, 0.0 * z, z], axis=1)
    engine = plane_engine(table={"effect": [magnet]}, effect=[film], material={"friction": None}, rolling=None)
    force = engine.run(posed(path), DT)["force"]
    gap, depth = np.maximum(z - 0.01, 0.0), np.maximum(0.01 - z, 0.0)
    expected = 1000.0 * depth - 2.0 * np.maximum(1.0 - gap / 0.02, 0.0) + 4.0 * 0.1 * (np.arange(321) > 0)
    # The velocity is that of the last millisecond; its rounding is 1e-16 m / 1 ms times 4 N s/m.
    assert force[:, 2] == pytest.approx(expected, abs=1e-9) and np.abs(force[:, :2]).max() < 1e-12


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("sideways", "depth"), [(0.002, 0.001), (0.001, 0.002)])
def test_viscosity_uses_the_velocity_relative_to_its_object(sideways: float, depth: float) -> None:
    """In a corner of a viscous floor at rest and a sliding wall: no viscous force, whichever has the larger load."""
    spring = {"stiffness_n_per_m": 1000.0}
    floor = {"name": "floor", "shape": "plane", "effect": [{"kind": "viscosity", "damping_ns_per_m": 10.0}]}
    wall = {"name": "wall", "shape": "plane", "orientation_wxyz": [0.5**0.5, 0.0, 0.5**0.5, 0.0]}
    sliding = {"motion": {"kind": "turntable", "rate_rad_per_s": 1.0, "pivot_m": [0.0, 0.1, 0.0]}}
    objects = [{**floor, "material": spring}, {**wall, **sliding, "material": spring}]
    running = Engine({"fingertip": {"radius_m": 0.01}, "object": objects})
    for _ in range(200):  # until the filtered velocity has decayed
        step = running.step([0.01 - sideways, 0.0, 0.01 - depth], [1.0, 0.0, 0.0, 0.0])
    assert step.force == pytest.approx(
        [1000.0 * sideways, 0.0, 1000.0 * depth], abs=1e-9
    )  # two springs; 1e-9 N is rounding


def test_viscosity_of_a_moving_object_drags_the_hand() -> None:
    effect = {"effect": [{"kind": "viscosity", "damping_ns_per_m": 10.0}]}
    motion = {"motion": {"kind": "turntable", "rate_rad_per_s": 1.0, "pivot_m": [0.0, 0.1, 0.0]}}
    table = {"name": "table", "shape": "plane", "material": {"stiffness_n_per_m": 1000.0}}
    running = Engine({"fingertip": {"radius_m": 0.01}, "object": [table | effect | motion]})
    for _ in range(50):
        step = running.step([0.0, 0.0, 0.009], [1.0, 0.0, 0.0, 0.0])
    # The chord of a tick of 1 mrad is inclined by half of it: 5e-4 of the drag of 1 N.
    assert step.force == pytest.approx([1.0, 0.0, 1.0], abs=1e-3)
