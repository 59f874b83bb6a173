"""Rolling methods do not drift off the object in many steps, and the fingertip's contact point matches its pose."""

from __future__ import annotations

import numpy as np
import pytest
from helpers.examples import Cases
from references.rolling_cases import METHODS, RADIUS, SHAPES, pairs, roll_long, touching

pytestmark = pytest.mark.plain

MILLION = 1_000_000
LONG = ("sphere", "box")
"""Shapes for the ten million steps of `make test-all`: a smooth one and one with edges. The others get a fifth of a
million, so that the test takes less than a minute; an ellipsoid's closest point is that slow."""
SHORT = 1000
"""Steps in `make test`: if a roll drifts off a smooth object, it does so by more than 1e-15 m per step."""


@pytest.mark.sampled(12)
@pytest.mark.scaled
@pytest.mark.parametrize(("method", "name"), pairs())
def test_contact_does_not_drift_off_the_object(cases: Cases, method: str, name: str) -> None:
    center, normal = touching(SHAPES[name], np.random.default_rng(31))
    ticks = cases(SHORT, 10 * MILLION if name in LONG else MILLION // 5)
    off, stretched, _ = roll_long(METHODS[method], SHAPES[name], RADIUS, center, normal, (6e-4, -3e-4, 4e-4), ticks)
    # On a plane the path leads far away, and rounding grows with the distance: 1e-16 of at most 10 m.
    assert off < 1e-12
    assert stretched < 1e-14
