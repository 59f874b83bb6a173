"""The measurement of how old poses and forces are when they are handed over: that its ages are from end to end."""

from __future__ import annotations

import importlib

import numpy as np


def test_a_force_is_found_by_its_size() -> None:
    tool = importlib.import_module("handover_age")
    written = np.array([1.0, 1.001, 1.002, 1.003])
    first, third = tool.LOWEST_N, tool.LOWEST_N + 2 * tool.STEP_N
    arrivals = np.array([[1.0004, first], [1.0009, first], [1.0027, third], [1.5, 0.0]])
    ages = tool.force_ages(arrivals, written)
    np.testing.assert_allclose(ages, [0.0004, np.nan, 0.0007, np.nan], atol=1e-12)  # rounding
