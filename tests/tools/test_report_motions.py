"""Analysis of the rows of a device report: motions, rotations, noise, pushes."""

import math
from typing import Any, Final

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from softfinger.drivers.base import SAMPLE_BUTTONS
from softfinger.tools.doctor import motions
from softfinger.tools.exchange import FORCE, ROW_SIZE, SAMPLE

pytestmark = pytest.mark.plain

RATE_HZ: Final = 1000.0


def poses(position: np.ndarray, orientation: np.ndarray | None = None) -> np.ndarray:
    """Rows with these positions (n, 3) m and orientations (n, 4)."""
    rows = np.zeros((len(position), ROW_SIZE))
    rows[:, SAMPLE : SAMPLE + 3] = position
    rows[:, SAMPLE + 3 : SAMPLE + 7] = (1.0, 0.0, 0.0, 0.0) if orientation is None else orientation
    return rows


@pytest.mark.parametrize(
    ("direction", "motion"),
    [
        ((0.03, 0.005, 0.0), "+x"),
        ((0.0, -0.04, 0.01), "-y"),
        ((0.001, 0.0, 0.02), "+z"),
        ((0.003, 0.0, -0.004), "no motion"),
        ((0.02, 0.02, 0.0), "not along one axis"),
    ],
)
def test_a_motion_has_an_axis_and_a_sense(direction: tuple[float, float, float], motion: str) -> None:
    share = np.clip(np.linspace(-0.5, 1.5, 1000), 0.0, 1.0)[:, None]
    path = share * np.array(direction) + np.sin(np.pi * share) * np.array([0.0, 0.0, 0.05])
    result = motions.measure_motion("ask", "translation", "+x", poses(path))
    assert result["seen"] == motion and result["agrees"] == (motion == "+x")
    np.testing.assert_allclose(result["vector"], direction, atol=1e-12)  # rounding of a median


def test_a_turn_is_the_rotation_between_first_and_last() -> None:
    """In the world frame as scipy's, for any initial orientation and any sign of a quaternion."""
    start = Rotation.from_rotvec([0.3, -0.2, 0.5])
    turn = np.array([0.05, -0.02, 0.6])
    ways = [Rotation.from_rotvec(share * turn) * start for share in np.linspace(0.0, 1.0, 50)]
    orientation = np.array([np.roll(rotation.as_quat(), 1) for rotation in ways])  # scipy has w last
    orientation[25:] *= -1.0
    result = motions.measure_motion("ask", "rotation", "+z", poses(np.zeros((50, 3)), orientation))
    np.testing.assert_allclose(result["vector"], turn, atol=1e-12)  # rounding of products
    assert result["seen"] == "+z" and result["unit"] == "rad"


def test_noise_at_rest_and_range_of_known_rows() -> None:
    random = np.random.default_rng(1)
    rows = poses(random.normal(size=(100_000, 3)) * (1e-6, 2e-6, 3e-6) + np.array([0.0, 0.01, 0.0]))
    rows[7, SAMPLE] = math.nan
    result = motions.measure_rest(rows, turns=False)
    assert result["not_finite"] == 1
    # of 1e5 samples a deviation is known to 1/sqrt(2e5), 0.2 %: five times that
    np.testing.assert_allclose(result["position_std_m"], (1e-6, 2e-6, 3e-6), rtol=0.011)
    assert result["rotation_std_rad"] is None
    span = motions.measure_range(rows)
    assert span is not None and span["position_min_m"][1] < 0.01 < span["position_max_m"][1]
    assert motions.measure_rest(rows[7:8], turns=False) is None
    rows[:3, SAMPLE + SAMPLE_BUTTONS] = (4.0, 1.0, 4.0)
    assert motions.list_masks(rows) == [0, 1, 4]


def pushed_rows(sign: float, mass: float, damping: float, stiffness: float) -> np.ndarray:
    seconds, hertz = 3.0, 1.0
    t = np.arange(round(seconds * RATE_HZ)) / RATE_HZ

    def force(at: Any) -> Any:
        return np.sin(math.pi * at / seconds) ** 2 * np.sin(2.0 * math.pi * hertz * at)

    def slope(at: float, state: np.ndarray) -> list[float]:
        return [state[1], (sign * force(at) - damping * state[1] - stiffness * state[0]) / mass]

    travel = solve_ivp(slope, (0.0, seconds), [0.0, 0.0], t_eval=t, rtol=1e-8, atol=1e-12).y[0]
    rows = poses(np.stack([np.zeros_like(travel), travel, np.zeros_like(travel)], axis=1))
    rows[:, FORCE + 2] = force(t)
    return rows


@pytest.mark.parametrize(
    ("holding", "plus", "minus"),
    [
        ((0.2, 5.0, 500.0), "+y", "free handle, or the wrong sign"),  # a hand that springs back
        ((0.2, 40.0, 100.0), "+y", "-y"),  # a soft hand
        ((0.3, 10.0, 1e-6), "+y", "-y"),  # a handle that is braked only
        ((2.0, 0.1, 1e-6), "free handle, or the wrong sign", "+y"),  # a free mass, which must be held for an answer
    ],
)  # fmt: skip
def test_a_push_shows_axis_and_sign(holding: tuple[float, float, float], plus: str, minus: str) -> None:
    for sign, motion in ((1.0, plus), (-1.0, minus)):
        result = motions.measure_response(2, 1.0, RATE_HZ, pushed_rows(sign, *holding))
        assert result["axis"] == "+z" and result["moved_axis"] == "y"
        assert motion in result["seen"], result
        assert result["share"] > 0.8  # a free mass also drifts off, which is not a part of the fit


def test_a_motion_of_the_hand_is_not_counted_as_a_push() -> None:
    rows = pushed_rows(1.0, 0.2, 5.0, 500.0)
    rows[:, SAMPLE] = 0.02 * np.sin(2.0 * math.pi * 2.7 * np.arange(len(rows)) / RATE_HZ)
    result = motions.measure_response(2, 1.0, RATE_HZ, rows)
    assert result["seen"].startswith(("not clear", "+y"))
    rows[:, SAMPLE + 1] = 0.0
    result = motions.measure_response(2, 1.0, RATE_HZ, rows)
    assert result["seen"].startswith("not clear")
    rows[:, SAMPLE] = 0.0
    assert motions.measure_response(2, 1.0, RATE_HZ, rows)["seen"] == "no motion"  # type: ignore[index]
    rows[:, FORCE + 2] = 0.0
    assert motions.measure_response(2, 1.0, RATE_HZ, rows) is None
