"""Simulated hands that an agent leads: the common base of the Gymnasium environments."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from softfinger.config.arrays import Array
from softfinger.config.errors import ConfigError
from softfinger.config.load import SceneSource, load_rig, load_scene
from softfinger.drivers.simulated.options import Options, make_simulation
from softfinger.drivers.simulated.plant import DELAY_LINE_SIZE, Intention, PlantInputs
from softfinger.proxy.bodies import begin_bodies
from softfinger.proxy.kernels.jit.decorators import entry
from softfinger.proxy.kernels.numerics import rotations
from softfinger.proxy.pose_checks import PoseError
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.proxy.records import Records
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.closed_loop import ClosedLoop, DrivenPlant

try:
    import gymnasium
    from gymnasium import spaces
except ImportError as missing:
    raise ConfigError(f"gymnasium is not installed ({missing}): pip install 'softfinger[gymnasium]'") from missing

__all__ = ["POSITION_BOUND_M", "Array", "LedHands", "Observation", "Point", "gymnasium", "make_box_space", "spaces"]

Observation = dict[str, Any]
Point = tuple[float, float, float]

POSITION_BOUND_M: Final = 1.0
"""Bound of observed positions, far beyond real values."""
RAMP_S: Final = 0.01
"""Shortest ramp of the guard: complete before the first step."""


def make_box_space(bound: float, *shape: int) -> spaces.Box:
    """Return a space of arrays with elements between -bound and bound."""
    return spaces.Box(-bound, bound, shape, np.float64)


@entry
def plan_goals(goals: Array, velocities: Array, lowest: Array, highest: Array, dt: float) -> None:
    """Fill `goals` (n, hands, 7), poses `dt` s apart, from the first of them on.

    velocities       (hands, 6) m/s, rad/s  linear along x, y, z, then angular about them, world frame
    lowest, highest  (hands, 3) m           bounds of the positions
    """
    for hand in range(goals.shape[1]):
        start = goals[0, hand]
        a, b, c = velocities[hand, 3], velocities[hand, 4], velocities[hand, 5]
        orientation = (start[3], start[4], start[5], start[6])
        for i in range(goals.shape[0]):
            t = i * dt
            for k in range(3):
                position = start[k] + t * velocities[hand, k]
                goals[i, hand, k] = min(max(position, lowest[hand, k]), highest[hand, k])
            q = orientation
            if a != 0.0 or b != 0.0 or c != 0.0:
                q = rotations.normalize(rotations.multiply(rotations.exp((t * a, t * b, t * c)), orientation))
            for k in range(4):
                goals[i, hand, 3 + k] = q[k]


class LedHands(gymnasium.Env[Observation, Array], ABC):
    """Simulated hands that an agent moves, one per finger of a scene. Subclasses define observation and reward.

    scene    as for `load_scene`; ConfigError if its number of fingers differs
    homes_m  (3,) m of each hand, its initial position, at rest
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  (as the base class declares it)
    setup: Any

    def __init__(self, scene: SceneSource, setup: Any, homes_m: Sequence[Point]) -> None:
        self.setup, self.config = setup, load_scene(scene)
        if (count := len(self.config.fingers)) != len(homes_m):
            raise ConfigError(f"fingers of the scene: {count}; hands of this environment: {len(homes_m)}")
        self._guard = load_rig("simulated", {"guard.ramp_s": RAMP_S}).guard
        self._devices = [make_simulation(Options(position_m=home, hand=setup.hand), setup.rate_hz) for home in homes_m]
        tuning = make_tuning(self.config, self._guard)
        self._loop = ClosedLoop(tuning, [device.state for device in self._devices])
        self._homes, self._dt = np.array(homes_m), 1.0 / setup.rate_hz
        self._lowest, self._highest = self._homes - setup.reach_m, self._homes + setup.reach_m
        self.action_space = spaces.Box(-1.0, 1.0, (6,), np.float64)

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Start an episode: hands at home, bodies at their initial poses, no contact history. Nothing is random."""
        super().reset(seed=seed)
        self._start()
        settling = max(self.setup.step_ticks, round(RAMP_S * self.setup.rate_hz))
        records = self._run(np.tile(self._goals, (settling + 1, 1, 1)))
        return self._observe(records), {"records": records}

    def step(self, action: Array) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Lead the hands for `step_ticks`; elements of the action beyond -1 and 1 are clamped.

        Raises PoseError unless the action is six finite numbers.
        """
        try:
            velocities = np.asarray(action, np.float64)
        except (TypeError, ValueError):
            velocities = np.zeros(0)
        if velocities.shape != (6,) or not np.isfinite(velocities).all():
            raise PoseError(f"action {action!r}: must be 6 finite numbers, each from -1 to 1")
        clamped: Array = np.minimum(np.maximum(velocities, -1.0), 1.0)  # a third of the time of np.clip
        records = self._run(self._make_goals(clamped))
        self._steps += 1
        is_truncated = self._steps >= self.setup.episode_steps
        return (
            self._observe(records),
            self.reward(records),
            self.is_terminated(records),
            is_truncated,
            {"records": records},
        )

    @abstractmethod
    def reward(self, records: Any) -> float:
        """Return the reward of a step from its records."""

    @abstractmethod
    def is_terminated(self, records: Any) -> bool:
        """Return True if a step ends the task, from its records."""

    @abstractmethod
    def _observe(self, records: Any) -> Observation:
        """Return the observation at the end of a step, from its records."""

    def _start(self) -> None:
        begin_bodies(self._loop.scene, self._dt)
        self._loop.reset()
        self._lines = [np.zeros(DELAY_LINE_SIZE) for _ in self._devices]
        self._goals: Array = np.array([[*home, 1.0, 0.0, 0.0, 0.0] for home in self._homes])
        self._ticks = self._steps = 0

    def _make_goals(self, action: Array) -> Array:
        """Return goals (ticks + 1, hands, 7) from the current ones on."""
        goals = np.empty((self.setup.step_ticks + 1, len(self._homes), 7))
        goals[0] = self._goals
        plan_goals(goals, self._compute_velocities(action), self._lowest, self._highest, self._dt)
        return goals

    def _compute_velocities(self, action: Array) -> Array:
        """Return the velocity (hands, 6) of each goal, m/s and rad/s; `action` has the translations (3 hands,)."""
        velocities = np.zeros((len(self._homes), 6))
        velocities[:, :3] = self.setup.speed_m_per_s * action.reshape(-1, 3)
        return velocities

    def _run(self, goals: Array) -> Any:
        """Run the ticks along goals (ticks + 1, hands, 7), the first is the current one; return records by finger."""
        intention = Intention(float(len(goals)), 0.0, (0.0, 0.0, 0.0), 0.0, 0.0)
        hands = tuple(
            DrivenPlant(device.plant, PlantInputs(intention, goals[:, index].reshape(-1), line))
            for index, (device, line) in enumerate(zip(self._devices, self._lines, strict=True))
        )
        records = np.zeros((len(goals) - 1, len(hands), RECORD_SIZE))
        # Tick numbers start at 0, as the index of the goals; the memory distinguishes the first tick of an episode.
        self._loop.run(hands, self._dt, 0, records)
        records[:, :, AT.timestamp] += self._ticks * self._dt
        records[:, :, AT.tick] += self._ticks
        self._ticks += len(records)
        self._goals = goals[-1]
        names = [finger.name for finger in self.config.fingers]
        return {name: Records(np.ascontiguousarray(records[:, index])) for index, name in enumerate(names)}
