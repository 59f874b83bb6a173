"""Environments of Gymnasium: its checker, the contact of the engine for the same poses, and a lift by script."""

import copy
import doctest
import pickle
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from softfinger.config.errors import ConfigError
from softfinger.proxy.engine import Engine
from softfinger.proxy.pose_checks import PoseError
from softfinger.proxy.records import Records
from softfinger.server.bridges import environment, lift_environment
from softfinger.server.bridges.environment import Touch

pytestmark = pytest.mark.plain

HOME = (0.0, 0.0, 0.0105)
"""0.5 mm above the plane for the fingertip."""


def play(env: Touch, actions: np.ndarray) -> Records:
    _, info = env.reset(seed=0)
    parts = [info["records"], *(env.step(action)[4]["records"] for action in actions)]
    return Records(np.concatenate(parts))


@pytest.mark.sampled(1)
@pytest.mark.parametrize("scene", ["paper-plane", "sphere"])
def test_gymnasium_checker_accepts_the_environment(scene: str) -> None:
    env = gymnasium.make(environment.NAME, scene=scene)
    check_env(env.unwrapped)
    steps = env.unwrapped.setup.episode_steps
    env.reset(seed=1)
    cut = [env.step(env.action_space.sample())[3] for _ in range(steps)]
    assert cut == [False] * (steps - 1) + [True]


def test_contact_equals_that_of_the_engine() -> None:
    actions = np.zeros((60, 6))
    actions[:20, 2], actions[20:40, 0], actions[40:, 4:] = -0.06, 0.08, 0.5
    records = play(Touch("paper-plane", home_m=HOME), actions)
    assert set(records["contact.mode"]) == {0, 1, 2}
    poses = np.hstack([records["probe.position"], records["probe.orientation"]])
    expected = Engine("paper-plane").run(poses)
    free_of_guard = records["servo.guard"] == 0
    assert free_of_guard.sum() > 1000
    for name in ("contact.mode", "contact.point", "contact.normal_force", "contact.spin", "probe.velocity"):
        np.testing.assert_array_equal(records[name], expected[name])
    np.testing.assert_array_equal(records["force"][free_of_guard], expected["force"][free_of_guard])
    assert (np.diff(records["tick"]) == 1).all()
    np.testing.assert_allclose(np.diff(records["timestamp"]), 0.001, rtol=1e-9)  # rounding of a sum of seconds


def test_hand_and_plane_share_the_depth() -> None:
    """Springs of hand and plane have 1000 N/m each: half of 1 mm of intended depth remains."""
    actions = np.zeros((150, 6))
    actions[:30, 2] = -0.05  # 1.5 mm down, 0.5 mm of them in the air
    records = play(Touch("paper-plane", home_m=HOME), actions)
    # The friction of the omega.6, at most 0.1 N on an axis, stops the handle anywhere within this range.
    assert records["force"][-1, 2] == pytest.approx(0.5, abs=0.11)


def test_the_goal_stays_within_reach() -> None:
    env = Touch("paper-plane", home_m=HOME, reach_m=0.01)
    env.reset()
    for _ in range(30):
        observation = env.step(np.array([9.0, -9.0, 9.0, 0.0, 0.0, 0.0]))[0]
    expected = [0.01, -0.01, HOME[2] + 0.01]
    np.testing.assert_allclose(observation["goal.position"], expected, atol=1e-12)  # rounding of a sum


@pytest.mark.parametrize("action", [[np.nan] * 6, [0.0] * 5, [[0.0] * 6], "up", [np.inf] * 6])
def test_an_invalid_action_is_refused(action: Any) -> None:
    env = Touch("paper-plane", home_m=HOME)
    env.reset()
    with pytest.raises(PoseError, match=r"action .*must be 6 finite numbers"):
        env.step(action)
    assert np.isfinite(env.step(np.zeros(6))[0]["probe.position"]).all()


def test_the_goal_turns_about_the_worlds_axes() -> None:
    env = Touch("frictionless-plane", turn_rad_per_s=1.0)
    env.reset()
    for axis in (5, 3):
        for _ in range(50):
            observation = env.step(np.eye(6)[axis])[0]
    half = np.sqrt([0.5 + 0.5 * np.cos(1.0), 0.5 - 0.5 * np.cos(1.0)])  # cos and sin of 0.5
    about_z, about_x = half[0], half[1]
    expected = [half[0] * about_z, about_x * half[0], -about_x * half[1], half[0] * half[1]]
    np.testing.assert_allclose(observation["goal.orientation"], expected, atol=1e-9)  # rounding of 100 products


def test_a_subclass_defines_reward_and_end() -> None:
    class Reach(Touch):
        def reward(self, records: Records) -> float:
            return float(records["contact.mode"].max())

        def is_terminated(self, records: Records) -> bool:
            return bool(records["contact.mode"].any())

    env = Reach("paper-plane", home_m=HOME)
    env.reset()
    for _ in range(60):
        _, reward, over, *_ = env.step(np.array([0.0, 0.0, -0.05, 0.0, 0.0, 0.0]))
        if over:
            break
    assert over and reward >= 1.0


def test_a_scene_of_two_fingers_is_refused() -> None:
    with pytest.raises(ConfigError, match="fingers of the scene: 2"):
        Touch("pinch")


def test_docstring_examples_run() -> None:
    results = doctest.testmod(environment)
    assert results.attempted and not results.failed


def test_the_example_of_the_docs_runs() -> None:
    page = (Path(__file__).parents[2] / "docs" / "operate" / "bridges.md").read_text()
    (program,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    exec(program, names := {})
    assert names["reward"] == -0.5  # in the air; 0.5 N are the target


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
