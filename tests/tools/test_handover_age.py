"""The measurement of how old poses and forces are when they are handed over: that its ages are from end to end."""

from __future__ import annotations

import importlib
import json
import sys
from pathlib import Path

import numpy as np
import pytest
from helpers.c_stub import COMPILER
from helpers.programs import run_program

SCRIPT = Path(__file__).parents[1] / "handover_age.py"


@pytest.mark.real_time
@pytest.mark.exhaustive
def test_every_driver_is_measured() -> None:
    command = (sys.executable, str(SCRIPT), "--ticks", "300", "--json")
    process = run_program(command, check=True)
    content = json.loads(process.stdout)
    assert content["ticks"] == 300
    measured = ["haply", *(["openhaptics"] if COMPILER else []), "serial, answer", "serial, stream"]
    assert list(content["seconds"]) == measured
    for name, ages in content["seconds"].items():
        for quantity, share in (("pose", "new"), ("force", "arrived")):
            assert 0.0 < ages[quantity]["p50"] <= ages[quantity]["p99"] <= ages[quantity]["most"] < 1.0, name
            assert 0.0 < ages[share] <= 1.0, name


def test_a_force_is_found_by_its_size() -> None:
    tool = importlib.import_module("handover_age")
    written = np.array([1.0, 1.001, 1.002, 1.003])
    first, third = tool.LOWEST_N, tool.LOWEST_N + 2 * tool.STEP_N
    arrivals = np.array([[1.0004, first], [1.0009, first], [1.0027, third], [1.5, 0.0]])
    ages = tool.force_ages(arrivals, written)
    np.testing.assert_allclose(ages, [0.0004, np.nan, 0.0007, np.nan], atol=1e-12)  # rounding
