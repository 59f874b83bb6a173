"""Environment of a lift: Gymnasium's checker, and two hands that lift the box by a script."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from softfinger.config.errors import ConfigError
from softfinger.server.bridges import lift_environment

pytestmark = pytest.mark.plain


def move(thumb: tuple[float, float, float], index: tuple[float, float, float]) -> np.ndarray:
    return np.array([*thumb, *index])


def test_gymnasium_checker_accepts_the_lift() -> None:
    env = gymnasium.make(lift_environment.NAME, episode_steps=2, step_ticks=5)
    check_env(env.unwrapped)
    env.reset(seed=1)
    assert [env.step(env.action_space.sample())[3] for _ in range(2)] == [False, True]


@pytest.mark.parametrize(("scene", "why"), [("paper-plane", "fingers of the scene: 1"), ("pinch", r"no \[world\]")])
def test_a_scene_without_a_grasp_is_refused(scene: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        lift_environment.Lift(scene)


@pytest.mark.exhaustive
def test_a_script_lifts_the_box() -> None:
    env = gymnasium.make(lift_environment.NAME).unwrapped
    squeeze, up, hold = move((1, 0, 0), (-1, 0, 0)), move((0, 0, 1), (0, 0, 1)), move((0, 0, 0), (0, 0, 0))
    ends = []
    for _ in range(2):
        start, _ = env.reset(seed=0)
        for action in [squeeze] * 8 + [hold] * 5 + [up] * 50 + [hold] * 10:
            observation, reward, terminated, _, info = env.step(action)
        ends.append(observation)
    height = observation["body.position"][2] - start["body.position"][2]
    assert height == pytest.approx(0.1, abs=0.002)  # less the sag of contacts and hands
    assert reward == pytest.approx(-abs(height - 0.1), abs=1e-3) and not terminated
    assert observation["thumb.force"][0] < -2.0 and observation["index.force"][0] > 2.0
    assert abs(observation["body.orientation"][0]) > 0.999
    assert len(info["records"]["thumb"]) == 20
    for name, value in ends[0].items():
        np.testing.assert_array_equal(value, ends[1][name])


@pytest.mark.sampled(1)
@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))])
def test_a_copy_continues_the_lift(duplicate: Callable[[Any], Any]) -> None:
    env = lift_environment.Lift(step_ticks=10)
    env.reset(seed=0)
    for _ in range(16):
        env.step(move((1, 0, 0), (-1, 0, 0)))
    copied = duplicate(env)
    assert copied.world is not env.world
    ahead = [env.step(move((0, 0, 1), (0, 0, 1))) for _ in range(3)]
    for observation, reward, *_ in ahead:
        copied_observation, copied_reward, *_ = copied.step(move((0, 0, 1), (0, 0, 1)))
        assert copied_reward == reward
        for name, value in observation.items():
            np.testing.assert_array_equal(copied_observation[name], value)
    start, copied_start = env.reset(seed=0)[0], copied.reset(seed=0)[0]
    np.testing.assert_array_equal(start["body.position"], copied_start["body.position"])
