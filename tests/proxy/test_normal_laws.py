"""Normal force laws: closed forms at rest and at a speed, energy, and the file. On the plane of conftest.paper_mapping:
K_n = 1000 N/m at d = 1 mm, no velocity filter, 1 kHz unless stated."""

import functools
from math import log
from typing import Any

import numpy as np
import pytest
from conftest import paper_mapping, paper_scene
from helpers.examples import examples
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from references.hand import plane_engine
from references.laws import Array, check_random_handling, work_of_the_hand
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from softfinger.config.load import build
from softfinger.config.schema import Material, Normal, Scene
from softfinger.proxy.engine import Engine
from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.contact.normal import compute_normal_force
from softfinger.proxy.laws import compile_normal_laws

pytestmark = pytest.mark.plain

R, K, D = 0.01, 1000.0, 0.001
LAWS: dict[str, dict[str, Any]] = {
    "Hertz": {"normal": {"exponent": 1.5}},
    "power": {"normal": {"exponent": 2.3, "depth_m": 0.002}},
    "Kelvin-Voigt": {"damping_ns_per_m": 5.0},
    "Kelvin-Voigt, Hertz": {"damping_ns_per_m": 5.0, "normal": {"exponent": 1.5}},
    "Hunt-Crossley": {"normal": {"damping_s_per_m": 2.0}},
    "Hunt-Crossley, Hertz": {"normal": {"exponent": 1.5, "damping_s_per_m": 2.0}},
}


def spring(law: dict[str, Any], depth: Any) -> Any:
    """Return K d (delta / d)^p, N."""
    normal = law.get("normal", {})
    d = normal.get("depth_m", D)
    return K * d * (np.maximum(depth, 0.0) / d) ** normal.get("exponent", 1.0)


def force(law: dict[str, Any], depth: Any, inwards: Any) -> Any:
    """Return the documented force, N, at a depth, m, and an inward speed, m/s."""
    elastic = spring(law, depth)
    viscous = law.get("damping_ns_per_m", 0.0) * inwards
    crossed = elastic * law.get("normal", {}).get("damping_s_per_m", 0.0) * inwards
    most = 2.0 * elastic if "damping_ns_per_m" in law else np.inf
    return np.clip(elastic + viscous + crossed, 0.0, most)


def smooth(law: dict[str, Any]) -> dict[str, Any]:
    return {"rolling": None, "material": {**law, "friction": None, "torsion": None}}


@functools.cache
def engine(name: str) -> Engine:
    return plane_engine(**smooth(LAWS[name]))


def poses(depths: Array) -> Array:
    rows = np.zeros((len(depths), 7))
    rows[:, 2], rows[:, 3] = R - depths, 1.0
    return rows


def pressed(running: Engine, depths: Array, dt: float = 0.001) -> Array:
    running.reset()
    return running.run(poses(depths), dt)["contact.normal_force"]


@pytest.mark.parametrize("name", list(LAWS))
def test_a_slow_press_has_the_closed_form(name: str) -> None:
    """At rest, f_N = K d (delta / d)^p at any depth; the intermediate ticks, which move, are skipped."""
    depths = np.repeat(np.concatenate([[-1e-3], np.geomspace(1e-6, 2e-2, 60), np.linspace(2e-2, 1e-5, 60)]), 2)
    forces = pressed(engine(name), depths)[1::2]
    # R - depth is rounded to half an ulp of R, 9e-19 m, which the power multiplies by at most 3.
    assert forces == pytest.approx(spring(LAWS[name], depths[1::2]), rel=1e-11, abs=1e-15)


@pytest.mark.sampled(6)
@pytest.mark.parametrize("name", list(LAWS))
@pytest.mark.parametrize("speed", [0.01, 0.1, 0.4, 0.9])
def test_a_press_at_a_speed_has_the_closed_form(name: str, speed: float) -> None:
    step = 9e-6
    dt = step / speed
    travel = np.arange(-5, int(0.004 / step)) * step
    depths = np.concatenate([travel, travel[-2::-1]])
    inwards = np.concatenate([[0.0], np.diff(depths) / dt])
    forces = pressed(engine(name), depths, dt)
    # The speed is the difference of two positions of about R: at most ulp(R) / dt = 2e-13 m/s.
    assert forces == pytest.approx(force(LAWS[name], depths, inwards), rel=1e-9, abs=1e-11)


def test_hertz_is_the_force_between_a_sphere_and_a_half_space() -> None:
    """K d^(1 - p) is 4/3 E* sqrt(r) if stiffness_n_per_m is 4/3 E* sqrt(r d)."""
    modulus = 2.5e4
    law = {"normal": {"exponent": 1.5, "depth_m": D}, "stiffness_n_per_m": 4.0 / 3.0 * modulus * (R * D) ** 0.5}
    running = plane_engine(**smooth(law))
    depths = np.repeat(np.linspace(1e-4, 5e-3, 20), 2)
    forces = pressed(running, depths)[1::2]
    assert forces == pytest.approx(4.0 / 3.0 * modulus * R**0.5 * depths[1::2] ** 1.5, rel=1e-12)


@pytest.mark.parametrize("name", list(LAWS))
@pytest.mark.parametrize("load", [0.02, 1.0, 12.0])
def test_depth_and_slope_under_a_force_are_those_of_the_law(name: str, load: float) -> None:
    """`depth_under` inverts the force law, and `stiffness_under` is its slope there by central differences."""
    material = paper_scene(**smooth(LAWS[name])).object[0].material
    depth = material.depth_under(load)
    assert spring(LAWS[name], depth) == pytest.approx(load, rel=1e-12)
    h = 1e-5 * depth
    slope = (spring(LAWS[name], depth + h) - spring(LAWS[name], depth - h)) / (2.0 * h)
    # Central differences have an error of h^2 f''' / 6, 1e-10 of the slope, and rounding of 1e-16 / 1e-5.
    assert material.stiffness_under(load) == pytest.approx(slope, rel=1e-9)


MASS = 0.2


def leaving_speed(law: dict[str, Any], speed: float) -> float:
    """Return the speed, m/s, at which a free mass leaves the plane, by SciPy's DOP853."""

    def rates(t: float, y: Array) -> list[float]:
        return [y[1], -float(force(law, y[0], y[1])) / MASS]

    def left(t: float, y: Array) -> float:
        return float(y[0])

    left.terminal, left.direction = True, -1.0
    solution = solve_ivp(rates, (0.0, 10.0), [0.0, speed], "DOP853", events=left, rtol=1e-12, atol=1e-14)
    return -float(solution.y_events[0][0][1])


def rendered_speed(running: Engine, speed: float, dt: float) -> float:
    """Return this speed with the contact step in the loop: velocity Verlet, of second order for the spring."""
    running.reset()
    running.step([0, 0, R + speed * dt], [1, 0, 0, 0], dt)
    x, v = R, -speed
    last = running.step([0, 0, x], [1, 0, 0, 0], dt).force[2]
    while x <= R:
        v += 0.5 * dt * last / MASS
        x += dt * v
        last = running.step([0, 0, x], [1, 0, 0, 0], dt).force[2]
        v += 0.5 * dt * last / MASS
    return v


@pytest.mark.sampled(1)
@pytest.mark.parametrize("name", ["Hertz", "Hunt-Crossley", "Hunt-Crossley, Hertz"])
def test_an_impact_matches_an_independent_integration(name: str) -> None:
    """The speed after impact is that of DOP853, of first order in the time step and of second after extrapolation."""
    speed = 0.2
    wanted = leaving_speed(LAWS[name], speed)
    coarse, fine = (rendered_speed(engine(name), speed, dt) for dt in (4e-5, 2e-5))
    # Damping uses the speed of half a step ago: an error of c a dt / 2 of the force, a = f / m at most 15 m/s^2, so
    # 6e-4.
    assert fine == pytest.approx(wanted, rel=6e-4)
    # Extrapolating two steps cancels that; the remaining error is of second order, (dt / 40 ms)^2 or some 1e-6, and
    # from leaving the plane within a step, where the force is zero.
    assert 2.0 * fine - coarse == pytest.approx(wanted, rel=2e-5)


@pytest.mark.sampled(1)
@pytest.mark.parametrize("speed", [0.02, 0.05, 0.1, 0.2])
@pytest.mark.parametrize("name", ["Hunt-Crossley", "Hunt-Crossley, Hertz"])
def test_restitution_is_hunt_and_crossleys(name: str, speed: float) -> None:
    """c v - log(1 + c v) = -c e v - log(1 - c e v) for any mass and spring; for small v, e = 1 - alpha v."""
    c = 2.0

    def balance(e: float) -> float:
        return c * speed - log(1.0 + c * speed) + c * e * speed + log(1.0 - c * e * speed)

    exact = brentq(balance, 1e-3, 1.0 - 1e-9, xtol=1e-14)
    # DOP853 at 1e-12, and the position of the event.
    assert leaving_speed(LAWS[name], speed) / speed == pytest.approx(exact, abs=1e-9)
    assert rendered_speed(engine(name), speed, 2e-5) / speed == pytest.approx(exact, abs=6e-4)
    # The published line is the series up to its second term; the third term, from the equation above, is 4/9 (c v)^2.
    assert exact == pytest.approx(1.0 - 2.0 / 3.0 * c * speed, abs=0.5 * (c * speed) ** 2)


@pytest.mark.parametrize("name", list(LAWS))
def test_a_finger_that_leaves_fast_is_not_pulled(name: str) -> None:
    """f_N is 0 at outward speeds above K d / B or 1 / c, and the closed form at slower ones."""
    (law,) = compile_normal_laws(paper_scene(**smooth(LAWS[name])))
    for depth in (1e-6, 1e-3, 5e-3):
        for outwards in (0.0, 0.1, 0.6, 10.0, 1e3):
            expected = force(LAWS[name], depth, -outwards)
            assert compute_normal_force(law, depth, outwards) == pytest.approx(expected, rel=1e-12, abs=1e-15)


@pytest.mark.sampled(3)
@pytest.mark.scaled
@pytest.mark.parametrize("name", list(LAWS))
def test_it_never_pulls_never_jumps_and_creates_no_energy(name: str) -> None:
    def check(records: Array) -> None:
        depths = R - records["probe.position"][:, 2]
        inwards = np.concatenate([[0.0], np.diff(depths) / 0.001])
        forces = records["contact.normal_force"]
        assert forces.min() >= 0.0
        crossed = LAWS[name].get("normal", {}).get("damping_s_per_m")
        most = 2.0 if crossed is None else 1.0 + crossed * np.maximum(inwards, 0.0)
        # Rounding of R - z, as above.
        assert (forces <= spring(LAWS[name], depths) * most * (1.0 + 1e-9) + 1e-12).all()
        exponent = LAWS[name].get("normal", {}).get("exponent", 1.0)
        depth = records["contact.penetration"]
        stored = spring(LAWS[name], depth) * depth / (exponent + 1.0)
        # Sums of some hundred terms of at most 1e-2 J, rounded.
        assert (work_of_the_hand(records) - stored).min() >= -1e-15 * len(records)

    check_random_handling(engine(name), 8, 300, check)


@pytest.mark.scaled
def test_no_law_in_its_range_gives_energy_in_a_closed_cycle() -> None:
    running = plane_engine(**smooth(LAWS["Hunt-Crossley, Hertz"]))
    crossed = st.floats(0.0, 100.0).map(lambda c: {"damping_s_per_m": c})
    plain = st.floats(0.0, 20.0).map(lambda b: {"damping_ns_per_m": b})

    @examples(50, 300)
    @given(st.lists(st.floats(-5e-4, 4e-3), min_size=1, max_size=12), st.floats(1.1, 3.0), crossed | plain)
    def check(depths: list[float], exponent: float, damping: dict[str, float]) -> None:
        viscous = damping.get("damping_ns_per_m", 0.0)
        normal = {"exponent": exponent, "damping_s_per_m": damping.get("damping_s_per_m", 0.0)}
        # Both dampings in one kernel, as in a scene with objects of either kind; a file may not combine them in one
        # object.
        law = Material(stiffness_n_per_m=K, damping_ns_per_m=viscous, normal=Normal(**normal))
        plane = paper_scene(**smooth({}))
        running.tune(replace(plane, object=(replace(plane.object[0], material=law),)))
        running.reset()
        records = running.run(poses(np.concatenate([[-1e-3], np.repeat(depths, 3), [-1e-3]])))
        # Sums of a dozen products of the force and displacements of 4 mm, rounded.
        assert work_of_the_hand(records)[-1] >= -1e-16 * records["contact.normal_force"].max()

    check()


def test_friction_follows_the_force_of_the_law() -> None:
    running = plane_engine(material={"normal": {"exponent": 1.5}})
    path = poses(np.full(300, 0.002))
    path[:, 0] = np.linspace(0.0, 0.015, 300)
    records = running.run(path)
    load = K * D * 2.0**1.5
    tangential = records["contact.tangential_force"]
    assert tangential.max() == pytest.approx(0.6 * load, rel=1e-12)
    assert tangential[-1] == pytest.approx(0.5 * load, rel=1e-12)


def test_each_wall_of_a_corner_has_a_separate_law() -> None:
    mapping = paper_mapping(**smooth({"normal": {"exponent": 1.5}}))
    floor = mapping["object"][0]
    springy = {"stiffness_n_per_m": 400.0, "normal": {"exponent": 2.0, "depth_m": 0.002}}
    mapping["object"] = [floor, {**floor, "name": "wall", "orientation_wxyz": [1, 0, 1, 0], "material": springy}]
    running = Engine(build(Scene, mapping, "corner"))
    path = np.zeros((40, 7))
    path[:, 0], path[:, 2], path[:, 3] = R - np.linspace(-1e-3, 3e-3, 40), R - np.linspace(-1e-3, 2e-3, 40), 1.0
    forces = running.run(path)["force"]
    depths = R - path[:, [0, 2]]
    # The equilibrium position between two planes is accurate to 1e-13 of the radius.
    wall = 400.0 * 0.002 * (np.maximum(depths[:, 0], 0.0) / 0.002) ** 2
    assert forces[:, 0] == pytest.approx(wall, abs=1e-12)
    assert forces[:, 2] == pytest.approx(spring(LAWS["Hertz"], depths[:, 1]), abs=1e-11)


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("share", "grows"), [(0.8, False), (1.2, True)])
def test_stability_depends_on_the_slope_at_the_force(share: float, grows: bool) -> None:
    """A perturbation of a weight on Hertz's wall decays if K(f) is below 2 b / T: the bound of Colgate and Schenkel,
    and the limit of Gil et al. for a slow loop."""
    mass, damping, period, weight = 0.2, 2.0, 0.001, 5.0
    # For Hertz's law K(f) = 1.5 K (f / (K d))^(1/3); solved for K.
    wanted = share * 2.0 * damping / period
    stiffness = (wanted / 1.5) ** 1.5 / (weight / D) ** 0.5
    scene = paper_scene(**smooth({**LAWS["Hertz"], "stiffness_n_per_m": stiffness}))
    assert scene.object[0].material.stiffness_under(weight) == pytest.approx(wanted, rel=1e-12)
    running = engine("Hertz")
    running.tune(scene)
    running.reset()
    running.step([0, 0, R + 0.001], [1, 0, 0, 0])
    # Exact solution of mass and damper under a constant force.
    fading = np.exp(-damping / mass * period)
    rest = R - scene.object[0].material.depth_under(weight)
    z, v, swing = rest, 1e-4, []
    for _ in range(4000):
        push = (running.step([0, 0, z], [1, 0, 0, 0]).force[2] - weight) / damping
        z, v = z + push * period + (v - push) * mass / damping * (1.0 - fading), push + (v - push) * fading
        swing.append(abs(z - rest))
    running.tune(paper_scene(**smooth(LAWS["Hertz"])))
    # (b - K T / 2) / 2 m is 1/s in both cases: a factor of e^3 between the first and the last second.
    ratio = max(swing[-1000:]) / max(swing[:1000])
    assert ratio > 5.0 if grows else ratio < 0.2


def test_a_linear_law_of_the_general_type_is_bit_identical() -> None:
    """delta^1 is delta and c = 0 adds nothing, so adding an object does not change other forces."""
    law = model.HuntCrossley(model.PowerNormal(1000.0, 1.0, 3.0), 0.0)
    rng = np.random.default_rng(0)
    for depth, speed in zip(rng.uniform(-1e-3, 5e-3, 500), rng.normal(scale=0.3, size=500), strict=True):
        linear = compute_normal_force(model.LinearNormal(1000.0, 3.0), depth, speed)
        assert compute_normal_force(law, depth, speed) == linear
