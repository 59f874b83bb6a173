"""Times of drivers on test doubles: figures of known times, and one measurement of each kind."""

import json

import driver_times
import numpy as np
import pytest


def test_a_force_is_found_by_its_size() -> None:
    written = np.array([1.0, 1.001, 1.002, 1.003])
    first, third = driver_times.LOWEST_N, driver_times.LOWEST_N + 2 * driver_times.STEP_N
    arrivals = np.array([[1.0004, first], [1.0009, first], [1.0027, third], [1.5, 0.0]])
    ages = driver_times.force_ages(arrivals, written)
    np.testing.assert_allclose(ages, [0.0004, np.nan, 0.0007, np.nan], atol=1e-12)  # rounding


def test_cost_of_known_times() -> None:
    bare, own = np.full(40, 1e-6), np.repeat((1e-7, 3e-7), 20)
    cost = driver_times.summarize_cost(np.column_stack([bare + own, bare]))
    wanted = {"driver": 1.2e-6, "bare": 1e-6, "own": 2e-7, "least": 1e-7, "most": 3e-7}
    assert cost == pytest.approx(wanted, rel=1e-9)  # differences of 1e-6


@pytest.mark.real_time
@pytest.mark.parametrize(
    ("measurement", "driver", "shares"), [("cost", "hid", ["whole"]), ("age", "haply", ["new", "arrived"])]
)
def test_a_measurement_is_complete_and_drawn(measurement, driver, shares, tmp_path, capsys):
    plot = tmp_path / "plot.png"
    assert driver_times.main([measurement, "--driver", driver, "--ticks", "100", "--json", "--plot", str(plot)]) == 0
    figures = json.loads(capsys.readouterr().out)["seconds"][driver]
    assert all(figures[share] > 0.0 for share in shares)
    assert plot.read_bytes().startswith(b"\x89PNG")


def test_bars_of_known_times() -> None:
    ages = {"haply": {"pose": {"p50": 1e-3, "p99": 2e-3}, "force": {"p50": 3e-3, "p99": 4e-3}}}
    wanted = {"haply, pose, p50": 1e3, "haply, pose, p99": 2e3, "haply, force, p50": 3e3, "haply, force, p99": 4e3}
    assert driver_times.age_bars(ages) == pytest.approx(wanted, rel=1e-12)  # rounding
    costs = driver_times.cost_bars({"hid": {"driver": 5e-7, "bare": 3e-7, "own": 2e-7}})
    assert costs == pytest.approx({"hid, driver": 0.5, "hid, bare": 0.3, "hid, own": 0.2}, rel=1e-12)
