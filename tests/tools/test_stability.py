"""Stability: limits found on the servo step against theory, theory against closed forms, and the verb."""

import json
import re
from pathlib import Path
from typing import Any

import msgspec
import numba
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from softfinger.config.load import build
from softfinger.config.schema import Scene
from softfinger.proxy.kernels.jit.pack import flatten
from softfinger.proxy.scene import build_scene
from softfinger.server.cli import main, make_parser
from softfinger.tools.stability import predicted
from softfinger.tools.stability.limit import WallCase, does_grow_at, find_limits, make_wall_and_weight
from softfinger.tools.stability.maps import VARIANTS
from softfinger.tools.stability.predicted import LinearLoop, find_linear_limit
from softfinger.tools.stability.runs import RunBlock, run_blocks

ROOT = Path(__file__).resolve().parents[2]

FOUND = 1e-3
"""Relative error of a computed limit: the bisection ends at 1e-4, and slow growth needs some margin."""


def random_cases(count: int, seed: int, **more: float) -> list[WallCase]:
    random = np.random.default_rng(seed)
    cases = []
    while len(cases) < count:
        mass, damping, rate = np.exp(random.uniform(np.log([0.05, 0.1, 500.0]), np.log([2.0, 10.0, 8000.0])))
        wall = float(random.uniform(0.0, 0.4) * mass * rate) if len(cases) % 2 else 0.0
        case = WallCase(
            mass_kg=float(mass), damping_ns_per_m=float(damping), rate_hz=float(rate), wall_damping_ns_per_m=wall,
            delay_ticks=int(random.integers(3)), **more,
        )  # fmt: skip
        if find_linear_limit(case.linear()) > 0.0:
            cases.append(case)
    return cases


def jury(mass: float, damping: float, period: float) -> float:
    fading = np.exp(-damping * period / mass)
    travel = -np.expm1(-damping * period / mass) * mass / damping  # x after a tick per unit of speed
    speed = -np.expm1(-damping * period / mass) / damping  # v after a tick per unit of force
    push = (period - travel) / damping  # x after a tick per unit of force
    # a1 = -(1 + fading - K push), a0 = fading (1 - K push) + K speed way
    turning = (1.0 - fading) / (speed * travel - fading * push)
    flipping = 2.0 * (1.0 + fading) / (push * (1.0 + fading) - speed * travel)
    return float(min(turning, flipping) if flipping > 0.0 else turning)


@pytest.mark.plain
@pytest.mark.parametrize("rate", [500.0, 1000.0, 8000.0])
@pytest.mark.parametrize(("mass", "damping"), [(0.1, 0.5), (1.0, 10.0), (0.05, 40.0), (0.05, 900.0)])
def test_linear_limit_is_that_of_jury(mass: float, damping: float, rate: float) -> None:
    """Without delay and wall damping the eigenvalues give the closed form."""
    limit = find_linear_limit(LinearLoop(mass, damping, 0.0, 1.0 / rate, 0))
    # The radius is taken to be 1 up to 1e-12; it grows with K by about half of b T / m, 1e-5 of it here at least.
    assert limit == pytest.approx(jury(mass, damping, 1.0 / rate), rel=1e-6)


CASES = random_cases(50, seed=4)


def crossings(loop: LinearLoop) -> list[float]:
    """Return every K > 0 at which an eigenvalue lies on the unit circle, from the open loop's frequency response.

    The closed loop has a pole at z = e^(j a) if 1 + G(z) z^-d (K + B D(z)) = 0, which gives K if that value is real.
    Roots of its imaginary part are bracketed on a fine grid.
    """
    a, b, t = np.zeros((3, 3)), loop.damping + loop.hand_damping, loop.period
    a[0, 1], a[1] = 1.0, np.array([-loop.hand_stiffness, -b, 1.0]) / loop.mass
    after = expm(a * t)

    def stiffness(angle: float) -> complex:
        z = np.exp(1j * angle)
        response = np.linalg.solve(z * np.eye(2) - after[:2, :2], after[:2, 2])[0]
        tau = loop.velocity_time_constant
        speed = (1.0 - 1.0 / z) / (tau + t - tau / z)
        return complex(-(z**loop.delay) / response - loop.wall_damping * speed)

    grid = np.linspace(1e-6, np.pi, 20_000)
    values = np.array([stiffness(angle) for angle in grid])
    turns = np.flatnonzero(np.diff(np.sign(values[:-1].imag)))
    angles = [brentq(lambda angle: stiffness(angle).imag, grid[i], grid[i + 1], xtol=1e-15) for i in turns]
    stiffnesses = [stiffness(angle).real for angle in [*angles, np.pi]]  # at z = -1 everything is real
    return sorted(k for k in stiffnesses if k > 0.0)


@pytest.mark.sampled(2)
@pytest.mark.plain
@pytest.mark.parametrize(
    "loop",
    [
        LinearLoop(0.3, 1.0, 0.0, 1e-3, 0),
        LinearLoop(0.05, 900.0, 0.0, 1.25e-4, 0),
        LinearLoop(0.3, 1.0, 20.0, 1e-3, 1),
        LinearLoop(0.1, 2.0, 5.0, 1e-3, 2, velocity_time_constant=0.004),
        LinearLoop(0.4, 1.5, 30.0, 5e-4, 0, 0.002, hand_stiffness=300.0, hand_damping=4.0),
        LinearLoop(0.4, 0.0, 3.0, 1e-3, 3, 0.0, hand_stiffness=2000.0, hand_damping=1.0),
    ],
)
def test_linear_limit_is_the_first_crossing_of_the_unit_circle(loop: LinearLoop) -> None:
    first = crossings(loop)[0]
    # The radius is taken to be 1 up to 1e-12; it grows with K by about half of b T / m, 1e-5 of it here at least.
    assert find_linear_limit(loop) == pytest.approx(first, rel=1e-6)
    below, above = predicted.compute_spectral_radius(loop, first * np.array([1.0 - 1e-5, 1.0 + 1e-5]))
    assert below < 1.0 < above


@pytest.mark.plain
@pytest.mark.parametrize("delay", [0, 1, 2, 5])
@pytest.mark.parametrize("wall", [0.0, 0.5, 2.0])
def test_linear_limit_of_a_slow_loop_is_the_published_one(delay: int, wall: float) -> None:
    """K (T / 2 + delay) = b + B, where the loop is slow against its ticks: Gil, Sanchez, Hulin, Preusche and Hirzinger
    (2009), Stability boundary for haptic rendering."""
    loop = LinearLoop(20.0, 1.0, wall, 1e-3, delay)
    # The neglected terms are of the order of K T^2 / m times the delays, here below 1e-3.
    assert find_linear_limit(loop) == pytest.approx((1.0 + wall) / (1e-3 * (0.5 + delay)), rel=2e-3)


def colgate_schenkel(loop: LinearLoop, stiffness: float) -> float:
    """Return the smallest b of a passive wall: the maximum of Colgate and Schenkel's expression."""
    angle = np.linspace(1e-4, np.pi, 200_001)
    z, tau, t = np.exp(1j * angle), loop.velocity_time_constant, loop.period
    wall = (stiffness + loop.wall_damping * (1.0 - 1.0 / z) / (tau + t - tau / z)) / z**loop.delay
    return float(np.max(t / 2.0 / (1.0 - np.cos(angle)) * ((1.0 - 1.0 / z) * wall).real))


@pytest.mark.plain
@pytest.mark.parametrize("delay", [0, 1, 2])
@pytest.mark.parametrize("tau", [0.0, 0.003])
def test_passive_limit_is_that_of_colgate_and_schenkel(delay: int, tau: float) -> None:
    """The bound is exact without delay and filter and for an undamped wall; otherwise it is on the safe side."""
    for wall in (0.0, 0.7, -0.7):
        loop = LinearLoop(0.3, 1.5, wall, 1e-3, delay, tau)
        needed = colgate_schenkel(loop, predicted.compute_passive_limit(loop))
        # Negative damping has its largest effect at low frequencies, where neither delay nor filter matters.
        exact = wall <= 0.0 or (delay == 0 and tau == 0.0)
        # The grid starts at 1e-4 rad, where the maximum for an undamped wall is too small by 1e-8 of it.
        assert needed == pytest.approx(1.5, rel=1e-6) if exact else needed < 1.5
    assert predicted.compute_passive_limit(LinearLoop(0.3, 1.0, 1.2, 1e-3, delay)) == 0.0


@pytest.mark.plain
def test_the_searched_wall_equals_a_scene_file() -> None:
    mapping = {
        "fingertip": {"radius_m": 0.01},
        "coupling": {"stiffness_n_per_m": 1.0, "damping_ns_per_m": 0.0},
        "probe": {"velocity_time_constant_s": 0.003},
        "effect": [{"kind": "constant_force", "force_n": [0.0, 0.0, -30.0]}],
        "object": [
            {
                "name": "wall", "shape": "plane", "position_m": [0.0, 0.0, 0.01],
                "material": {"stiffness_n_per_m": 1500.0, "damping_ns_per_m": 2.0},
            }
        ],
    }  # fmt: skip
    scene = build_scene(build(Scene, mapping, "test"))
    wall = make_wall_and_weight(1500.0, 2.0, 0.003, 0.0, 0.02).scene
    assert numba.typeof(wall) == numba.typeof(scene)
    np.testing.assert_array_equal(flatten(wall), flatten(scene))


def test_found_limits_are_the_linear_ones() -> None:
    """With and without a hand and a filter of the velocity."""
    more = {"hand_mass_kg": 0.1, "hand_damping_ns_per_m": 3.0, "hand_stiffness_n_per_m": 400.0}
    for row in find_limits([*CASES, *random_cases(8, seed=5, velocity_time_constant_s=0.002, **more)]):
        assert row["limit_n_per_m"] == pytest.approx(row["predicted_n_per_m"], rel=FOUND), row


@pytest.mark.sampled(2)
@pytest.mark.parametrize("variant", [name for name in VARIANTS if "encoder" not in name])
def test_no_passive_wall_is_unstable(variant: str) -> None:
    for case in CASES[::5]:  # walls without damping are passive up to some stiffness
        variant_case = msgspec.structs.replace(case, **VARIANTS[variant])
        damped = msgspec.structs.replace(variant_case, wall_damping_ns_per_m=0.5 * variant_case.damping_ns_per_m)
        for inside in (variant_case, damped):
            bound = predicted.compute_passive_limit(inside.linear())
            for share in (0.1, 0.5, 0.9, 0.999):
                assert bound == 0.0 or not does_grow_at(inside, share * bound), (inside, share)
    if variant == "device alone":
        assert all(does_grow_at(case, 1.02 * find_linear_limit(case.linear())) for case in CASES[::5])


def test_friction_of_the_mechanism_stabilises_stiffer_walls() -> None:
    limits = [row["limit_n_per_m"] for row in find_limits([WallCase(friction_n=f) for f in (0.0, 0.02, 0.05)])]
    assert limits[0] * 1.2 < limits[1] and limits[1] * 1.2 < limits[2]


def test_oscillations_of_encoder_steps_are_not_instability() -> None:
    coarse, fine = find_limits([WallCase(resolution_m=20e-6), WallCase()])
    # Within the describing function of a quantiser, which is 1 to 1.27 at twenty steps' swing and less.
    assert coarse["limit_n_per_m"] == pytest.approx(fine["limit_n_per_m"], rel=0.27)


def test_friction_may_stop_a_knock_at_once(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--friction", "10", "--damping", "1000", "--mass", "0.001", "--resolution", "1e-5"]
    assert stability(capsys, *words)["cases"][0]["limit_n_per_m"] is None and main(["stability", *words]) == 0
    assert "no limit" in capsys.readouterr().out


def test_an_undamped_loop_has_no_stable_wall() -> None:
    (row,) = find_limits([WallCase(damping_ns_per_m=0.0)])
    # The search ends a million times below its start, which is a millionth of m / T^2.
    assert row["predicted_n_per_m"] == 0.0 and row["limit_n_per_m"] < 1e-6 * 0.2e6


def test_random_runs_do_not_diverge_on_passive_walls() -> None:
    blocks = [RunBlock(number, 300, 1000, 0) for number in range(4)]
    parts = run_blocks(blocks)
    assert parts == run_blocks(blocks[:2]) + run_blocks(blocks[2:])
    sums = {key: sum(part[key] for part in parts) for key in parts[0]}
    assert sums["runs"] == 1200 and sums["passive_left"] == 0
    # A wall is drawn from a tenth to ten times the passive stiffness: a good part of either kind.
    assert 100 < sums["left"] < 600 and 200 < sums["passive"] < 800
    assert sums["ticks"] < 1200 * 1000, "those that grew out of reach end early"


def stability(capsys: pytest.CaptureFixture[str], *words: str) -> Any:
    assert main(["stability", *words, "--json"]) == 0
    return json.loads(capsys.readouterr().out)


def test_verb_gives_one_case(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--mass", "0.3", "--damping", "1", "--wall-damping", "0.25", "--rate", "1000", "--delay", "1"]
    (row,) = stability(capsys, *words)["cases"]
    assert (row["mass_kg"], row["damping_ns_per_m"], row["wall_damping_ns_per_m"]) == (0.3, 1.0, 0.25)
    assert (row["rate_hz"], row["delay_ticks"]) == (1000.0, 1)
    assert row["limit_n_per_m"] == pytest.approx(row["predicted_n_per_m"], rel=FOUND)
    assert row["passive_n_per_m"] == pytest.approx(2 * (1.0 - 0.25) / (3 * 1e-3))  # (2 d + 1) K T / 2 = b - B
    assert main(["stability", *words]) == 0
    assert f"{row['limit_n_per_m']:.2f}" in capsys.readouterr().out


def test_verb_times_random_runs(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    words = ["--cases", "1500", "--ticks", "50", "--results", str(tmp_path / "runs.mcap")]
    runs = stability(capsys, *words)["runs"]
    assert runs["runs"] == 1500 and runs["ticks"] <= 1500 * 50 and runs["passive_left"] == 0
    assert runs["million_runs_s"] == pytest.approx(1e9 / runs["ticks_per_s"])
    resumed = stability(capsys, *words)["runs"]
    assert (resumed["ticks"], resumed["left"], resumed["ticks_per_s"]) == (runs["ticks"], runs["left"], None)


@pytest.mark.plain
def test_every_figure_of_the_page_has_a_command() -> None:
    page = (ROOT / "docs" / "measured" / "stability.md").read_text()
    commands = re.findall(r"^    softfinger (stability[^#\n]*)", page, re.MULTILINE)
    plots = {str(make_parser().parse_args(command.split()).plot) for command in commands}
    figures = re.findall(r"\]\(\.\./(figures/stability-[a-z]+\.svg)\)", page)
    assert len(figures) == 4 and {f"docs/{name}" for name in figures} <= plots
    for name in figures:
        text = (ROOT / "docs" / name).read_text()
        assert len(text) < 80_000 and "dc:date" not in text
