"""Copies and pickles of an Engine continue with the same bits, in separate memory."""

import copy
import pickle
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from softfinger.proxy.engine import Engine

pytestmark = pytest.mark.plain

POSE = [0.001, 0.0, 0.0095], [1.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("scene", ["paper-plane", "heightmap", "plates", "roll-a-pencil"])
@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda engine: pickle.loads(pickle.dumps(engine))])
def test_a_copy_continues(scene: str, duplicate: Callable[[Engine], Engine]) -> None:
    engine = Engine(scene)
    engine.step(*POSE)
    copied = duplicate(engine)
    for x in (0.002, 0.003):
        pose: Any = [x, 0.0, 0.009], POSE[1]
        np.testing.assert_array_equal(copied.step(*pose).record, engine.step(*pose).record)
    before, third = engine._state.copy(), duplicate(engine)
    copied.reset()
    copied.step(*POSE)
    np.testing.assert_array_equal(engine._state, before)
    np.testing.assert_array_equal(engine.step(*POSE).record, third.step(*POSE).record)
