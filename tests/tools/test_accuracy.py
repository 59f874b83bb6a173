"""`softfinger accuracy`: its numbers against closed forms and the paper's, its motions, its choice of methods."""

import argparse
import contextlib
import io
import json
import re
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from references.paper import published
from references.rotation import matrix

from softfinger.config.errors import ConfigError
from softfinger.proxy.kernels import model
from softfinger.server.cli import main, make_parser
from softfinger.server.loop.clock import make_stopwatch
from softfinger.tools.accuracy import cases, front, montana, paper, verb
from softfinger.tools.accuracy.classical import MAX_STEP_SHARE, Steps, roll_classical
from softfinger.tools.accuracy.reference import roll_path
from softfinger.tools.options import METHODS, MOTIONS, SURFACES

R = cases.RADIUS_M
W, SPIN = 2.0, 0.5
"""Rotation rate (rad/s) and spin over roll of the standard motion."""
ROLL_RATE, SPIN_RATE = W / np.hypot(1.0, SPIN), W * SPIN / np.hypot(1.0, SPIN)
TORUS = model.Torus(0.05, 0.02, 1.0)


def options(*words: str) -> argparse.Namespace:
    return make_parser().parse_args(["accuracy", *words])


@pytest.mark.plain
def test_the_options_name_every_surface_and_method() -> None:
    """The names are written apart from the kernels, so that `--help` imports none."""
    assert (tuple(cases.SURFACES), tuple(cases.METHODS)) == (SURFACES, METHODS)


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    words = ["accuracy", "--quick", "--json", "--surface", "plane", "torus", "--rate", "8", "16", "32", "1000"]
    methods = ["euler_zxz", "rotation_vector", "midpoint", "montana_rk4"]
    plot = tmp_path_factory.mktemp("accuracy") / "front.png"
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert main([*words, "--method", *methods, "--plot", str(plot)]) == 0
    assert plot.read_bytes().startswith(b"\x89PNG")
    content: dict[str, Any] = json.loads(printed.getvalue())
    return content


def test_json_has_the_documented_keys(result: dict[str, Any]) -> None:
    assert {"motion", "method", "max_error_mm"} <= result["paper"][0].keys()
    speed = {"classical_ns_per_step", "euler_zxz_ns_per_step", "rotation_vector_ns_per_step", "ratio"}
    assert speed <= result["speed"].keys()
    trade = {"surface", "method", "step_s", "max_error_m", "ns_per_step", "spin_error_rad", "drift_m"}
    assert all(trade <= row.keys() for row in result["trade"])
    # Four methods on the plane and, without the closed form, three on the torus; two motions, four rates.
    assert len(result["trade"]) == (4 + 3) * 2 * 4
    assert {(row["surface"], row["motion"]) for row in result["pareto"]} == {
        (surface, motion) for surface in ("plane", "torus") for motion in ("constant", "changing")
    }
    assert {row["rate_hz"] for row in result["recommendations"]} == {8.0, 16.0, 32.0, 1000.0}


PAPER = [
    # axes, method, largest differences along x and y in mm
    ("contact_frame", "euler_zxz", (0.00387, 0.00393)),
    ("contact_frame", "euler_zyx", (0.34067, 0.57934)),
    ("contact_frame", "rotation_vector", (0.27901, 0.33110)),
    ("world", "euler_zxz", (0.00208, 0.00313)),
    ("world", "euler_zyx", (0.76124, 0.49121)),
    ("world", "rotation_vector", (0.0, 0.0)),
]


@pytest.mark.parametrize(("motion", "method", "largest_mm"), PAPER)
def test_paper_rows(result: dict[str, Any], motion: str, method: str, largest_mm: tuple[float, float]) -> None:
    (row,) = (row for row in result["paper"] if (row["motion"], row["method"]) == (motion, method))
    # Known to 1e-5 mm.
    assert row["max_error_mm"] == pytest.approx([*largest_mm, 0.0], abs=0.6e-5)
    x, y, _ = row["max_error_mm"]
    text = (Path(__file__).parents[2] / "docs" / "measured" / "accuracy.md").read_text(encoding="utf-8")
    assert re.search(rf"^\| {motion} \| {method} \| \w+ \| {x:.5f} \| {y:.5f} \|", text, re.MULTILINE)


def test_exact_methods_are_exact_in_the_paper(result: dict[str, Any]) -> None:
    """Along the line, all methods that use the logarithm and the classical method are exact to 1e-12 m."""
    for row in result["paper"]:
        if row["motion"] == "world" and not row["method"].startswith("euler"):
            assert max(row["max_error_mm"]) < 1e-9


def test_the_experiment_is_the_published_one() -> None:
    table = published()
    assert (table["radius"], table["sampling_time"]) == (R, paper.STEP_S)
    assert table["duration"] == paper.STEPS * paper.STEP_S
    assert (table["delta_psi"], table["delta_theta"], table["delta_phi"]) == paper.TURN_RAD


def test_reference_paths_of_the_paper() -> None:
    (x, y, z), k = paper.TURN_RAD, np.arange(paper.STEPS + 1)
    straight = R * complex(y, -x)
    for motion, path in (("world", straight * k), ("contact_frame", straight * (np.exp(1j * z * k) - 1) / (1j * z))):
        positions = paper.compute_exact_path(motion)
        # Integrated to 1e-13 of some centimetres.
        assert positions == pytest.approx(np.column_stack([path.real, path.imag, 0 * k]), abs=1e-14)


def test_speed_ratio_equals_that_of_the_times(result: dict[str, Any]) -> None:
    speed = result["speed"]
    assert speed["ratio"] == speed["classical_ns_per_step"] / speed["euler_zxz_ns_per_step"]
    classical = speed["classical"]
    assert (classical["relative_tolerance"], classical["absolute_tolerance"]) == (1e-3, 1e-6)
    # No step is longer than a tenth; some begin with a shorter one, which makes eleven.
    assert 61 <= classical["evaluations_per_step"] < 67
    assert classical["known_ahead"]["evaluations_per_step"] < classical["without_step_bound"]["evaluations_per_step"]
    assert classical["without_step_bound"]["evaluations_per_step"] < 61


def test_classical_method_on_a_torus() -> None:
    at = montana.Coordinates(0.0, 0.0, 0.3, 0.4, 0.2)
    here = montana.compute_chart(TORUS, at.u_o, at.v_o)
    center, w = np.array(here.point) + R * np.array(here.z), np.array([3.0, 2.0, 5.0])
    half = 0.005 * np.linalg.norm(w)
    dq = np.tile([np.cos(half), *(np.sin(half) / np.linalg.norm(w) * w)], (20, 1))
    path = np.zeros((20, 3))
    for spin_rate in (0.0, 4.0):

        def rate(t: float, spin_rate: float = spin_rate) -> Any:
            c, s, n = np.cos(spin_rate * t), np.sin(spin_rate * t), np.array(here.z)
            return c * w + s * np.cross(n, w) + (1 - c) * (w @ n) * n

        count = roll_classical(TORUS, R, at, Steps(dq, 0.01, spin_rate), MAX_STEP_SHARE, path, make_stopwatch(1))
        points, _, _ = roll_path(TORUS, R, center, here.z, rate, 0.2).at(np.linspace(0.01, 0.2, 20))
        # Steps of 6 mrad at the fifth order; the tolerance by itself would allow 1e-3 of the coordinates.
        assert np.abs(path - points).max() < 1e-11
        assert count >= 61 * 20


def test_errors_on_the_plane_are_the_closed_forms(result: dict[str, Any]) -> None:
    """ZXZ angles miss roll and spin of a step by half-angle formulas; the error is largest at the end."""
    for row in (row for row in result["trade"] if (row["surface"], row["motion"]) == ("plane", "constant")):
        half, count = W * row["step_s"] / 2, row["steps"]
        across, along = np.sin(half) * ROLL_RATE / W, np.sin(half) * SPIN_RATE / W
        theta, spin = 2 * np.arctan2(across, np.hypot(np.cos(half), along)), 2 * np.arctan2(along, np.cos(half))
        exact = row["method"] != "euler_zxz"
        error = 0.0 if exact else R * abs(count * theta - ROLL_RATE)
        turned = 0.0 if exact else abs(count * spin - SPIN_RATE)
        # Rounding of up to a thousand steps of 20 mm and 1 rad altogether.
        assert row["max_error_m"] == pytest.approx(error, abs=1e-14)
        assert row["spin_error_rad"] == pytest.approx(turned, abs=1e-13)


def test_orders(result: dict[str, Any]) -> None:
    orders = {(row["surface"], row["motion"], row["method"]): row["order"] for row in result["orders"]}
    # The next order's share at the steps from 1/32 to 1/8 s, of up to a quarter of a radian.
    for key, order in {
        ("plane", "constant", "euler_zxz"): 2.0,
        ("torus", "constant", "euler_zxz"): 1.0,
        ("torus", "constant", "midpoint"): 2.0,
        ("torus", "constant", "montana_rk4"): 4.0,
        ("plane", "changing", "euler_zxz"): 2.0,
        ("plane", "changing", "rotation_vector"): 2.0,
        ("torus", "changing", "midpoint"): 2.0,
        ("torus", "changing", "montana_rk4"): 2.0,
    }.items():
        assert orders[key] == pytest.approx(order, abs=0.1)
    for method in ("rotation_vector", "midpoint", "montana_rk4"):
        assert orders["plane", "constant", method] is None


def test_nothing_drifts(result: dict[str, Any]) -> None:
    """The contact point is on the surface after every thousand steps, to rounding of centimetres."""
    assert all(0.0 <= row["drift_m"] < 1e-15 for row in result["trade"])
    assert {row["steps"] for row in result["drift"]} == {verb.QUICK_DRIFT_STEPS}


@pytest.mark.parametrize("motion", MOTIONS)
def test_motion_turns_at_its_nominal_rates(motion: cases.Motion) -> None:
    h, t, normal = 1e-5, np.linspace(0.0, 0.9, 7), (0.36, 0.48, 0.8)
    path = cases.RollingCase("plane", "midpoint", motion, 1000.0, 3.0, None, 0.7, 1)
    assert cases.compute_orientations(path, normal, np.zeros(1))[0] == pytest.approx([1, 0, 0, 0])
    before, at, after = (cases.compute_orientations(path, normal, t + s) for s in (-h, 0.0, h))
    w = cases.compute_angular_velocity(path, normal)
    for time, a, q, b in zip(t, before, at, after, strict=True):
        skew = (matrix(b) - matrix(a)) / (2 * h) @ matrix(q).T
        # Central differences: h^2 times the third derivative, some tens per second cubed.
        assert [skew[2, 1], skew[0, 2], skew[1, 0]] == pytest.approx(w(time), abs=1e-7)
    first, n = w(0.0), np.array(normal)
    assert np.linalg.norm(first) == pytest.approx(3.0)
    assert first @ n / np.linalg.norm(first - (first @ n) * n) == pytest.approx(0.7)


def test_impossible_cases_are_left_out() -> None:
    """No fingertip larger than the hollow it is in, no step of half a turn, no closed form where there is none."""
    sweep, drift = verb.plan_sweep(options())
    selected = cases.list_cases(sweep)
    assert all(case.turn_rate / case.rate_hz < np.pi for case in selected)
    assert {case.surface for case in selected if case.curvature_ratio == 10.0} == {
        "sphere", "cylinder", "capped-cylinder", "capsule", "box", "ellipsoid",
    }  # fmt: skip
    pairs = {(case.surface, case.method) for case in selected}
    assert pairs == {(case.surface, case.method) for case in drift} and ("box", "rotation_vector") in pairs
    assert ("torus", "rotation_vector") not in pairs
    assert len(set(selected)) == len(selected)


@pytest.mark.parametrize("surface", [name for name in cases.SURFACES if name != "plane"])
def test_curvature_ratio_scales_the_surface(surface: str) -> None:
    own, _, _ = cases.make_contact(surface, None)
    shape, center, normal = cases.make_contact(surface, 0.1)
    scale = 10 * R / cases.SURFACES[surface].size
    for name, value in own._asdict().items():
        expected = value if name == "side" else scale * np.array(value)
        assert getattr(shape, name) == pytest.approx(expected)
    assert np.linalg.norm(normal) == pytest.approx(1.0)
    assert np.isfinite(center).all()


def point(method: str, ns: float, error: float, rate: float = 1000.0, **more: Any) -> dict[str, Any]:
    row = {"surface": "s", "motion": "constant", "method": method, "ns_per_step": ns, "max_error_m": error}
    row |= {"rate_hz": rate, "step_s": 1 / rate, "given_ratio": None, "turn_rate_rad_per_s": 2.0, "spin_ratio": 0.5}
    return row | more


def test_front_of_hand_made_points() -> None:
    """No cheaper point has at most twice its error; errors at the level of rounding are equal."""
    made = [
        point("dear and bad", 100, 1e-3),
        point("exact", 80, 1e-17),
        point("cheap", 10, 1e-4),
        point("hardly better, dearer", 20, 0.55e-4),
        point("better", 30, 1e-7),
        point("exact too, dearer", 90, 0.0),
        # Costs 5 ns a millisecond of motion: the cheapest of all.
        point("slow servo", 50, 1e-2, rate=100.0),
    ]
    assert [row["method"] for row in front.find_front(made)] == ["slow servo", "cheap", "better", "exact"]
    assert front.find_front([]) == []
    assert [row["method"] for row in front.find_front(made[:1])] == ["dear and bad"]


def test_fronts_and_orders_look_at_the_ladder_only() -> None:
    made = [point("a", 10, 1e-4), point("a", 1, 1e-9, turn_rate_rad_per_s=1.0)]
    made += [point("a", 1, 1e-9, spin_ratio=0.0), point("a", 1, 1e-9, given_ratio=0.1)]
    assert front.find_fronts(made) == made[:1]
    ladder = [point("a", 10, 3.0 / rate**3, rate=rate) for rate in (100.0, 200.0, 300.0, 400.0)]
    (order,) = front.fit_orders(ladder + made[1:])
    assert order["order"] == pytest.approx(3.0)
    # From the three smallest errors: too long steps are outside the range of the law.
    (order,) = front.fit_orders([point("a", 10, 1.0, rate=50.0), *ladder])
    assert order["order"] == pytest.approx(3.0)


def test_recommendations() -> None:
    made = [point("fast", 10, 1e-6), point("fine", 40, 1e-9), point("worse", 50, 1e-8)]
    advice = front.list_recommendations(made, (1e-5, 1e-7, 1e-12))
    assert [row["method"] for row in advice] == ["fast", "fine", None]
    assert advice[0]["sentence"] == "s, constant rate: for an error below 10 um at 1000 Hz use fast: 10 ns"
    assert advice[2]["sentence"].endswith("no method does: fine reaches 1 nm")


def test_missing_scipy_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without scipy the error names the package to install."""
    monkeypatch.setitem(sys.modules, "scipy.integrate", None)
    with pytest.raises(ConfigError, match=r"pip install 'softfinger\[accuracy\]'"):
        paper.compute_exact_path("world")
