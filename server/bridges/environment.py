"""Gymnasium environment of a fingertip, on the contact model and a simulated hand, compiled and without a clock.

    import gymnasium
    import softfinger.server.bridges.environment        # registers the name

    env = gymnasium.make("softfinger/Touch-v0", scene="sphere")

The agent sets the goal of the hand, position and orientation. Spring and damper of the hand pull the handle there, as
far as the contact allows, tick by tick as in the daemon with the device `simulated`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from softfinger.config.load import SceneSource
from softfinger.drivers.simulated.options import Hand
from softfinger.proxy.record import NAMED, Field
from softfinger.proxy.records import Records
from softfinger.server.bridges.led_hands import (
    POSITION_BOUND_M,
    Array,
    LedHands,
    Observation,
    Point,
    gymnasium,
    make_box_space,
    spaces,
)

NAME: Final = "softfinger/Touch-v0"
SPEED_BOUND_M_PER_S: Final = 100.0
DEPTH_BOUND_M: Final = 0.1
SPIN_BOUND_RAD: Final = 1e3
"""Bounds of observations, far beyond real values."""


@dataclass(frozen=True)
class EnvironmentParameters:
    """Parameters of an environment, except the scene.

    home_m           (3,) m       initial position of hand and fingertip, at rest
    reach_m          m            largest distance of the hand's goal from there, along each axis
    speed_m_per_s    m/s          largest speed of the goal, along each axis
    turn_rad_per_s   rad/s        largest angular velocity of the goal, about each world axis
    step_ticks       ticks        of a step of the environment
    episode_steps    steps        until an episode is truncated
    goal_n           N            target of the task: normal force to maintain
    rate_hz          Hz           of the ticks
    hand                          impedance of the hand on the handle of an omega.6
    """

    home_m: Point = (0.0, 0.0, 0.015)
    reach_m: float = 0.03
    speed_m_per_s: float = 0.05
    turn_rad_per_s: float = 2.0
    step_ticks: int = 20
    episode_steps: int = 200
    goal_n: float = 0.5
    rate_hz: float = 1000.0
    hand: Hand = field(default_factory=Hand)


class Touch(LedHands):
    """Fingertip that the agent moves along a scene's objects; for scenes with one finger.

    scene    as for `load_scene`
    setup    parameters; keywords of `EnvironmentParameters` may be given instead: Touch("sphere", goal_n=1.0)

    action       (6,) from -1 to 1, constant during a step: velocity of the hand's goal along x, y, z as a fraction of
                 `speed_m_per_s`, angular velocity about x, y, z as a fraction of `turn_rad_per_s`, world frame
    observation  dict of arrays, with names and units of the telemetry at the step's last tick, and pose of the goal
    reward       negative mean distance (N) of the normal force from `goal_n` over the ticks of the step
    info         "records": Records (step_ticks, RECORD_SIZE), every tick of the step

    Never terminated; truncated after `episode_steps`. For another task override `reward` and `is_terminated`.

    >>> env = Touch("paper-plane", home_m=(0.0, 0.0, 0.0105))
    >>> first, _ = env.reset(seed=1)
    >>> for _ in range(20):
    ...     seen, reward, terminated, truncated, info = env.step(np.array([0.0, 0.0, -0.06, 0.0, 0.0, 0.0]))
    >>> int(seen["contact.mode"]), bool(seen["force"][2] > 0.1), len(info["records"])
    (1, True, 20)
    """

    setup: EnvironmentParameters

    def __init__(
        self, scene: SceneSource = "paper-plane", setup: EnvironmentParameters | None = None, **changes: Any
    ) -> None:
        setup = setup or EnvironmentParameters(**changes)
        super().__init__(scene, setup, [setup.home_m])
        self._scale: Final = np.repeat([setup.speed_m_per_s, setup.turn_rad_per_s], 3)
        force, torque = self._guard.force_max_n, self._guard.torque_max_nm
        self._fields: Final[dict[str, spaces.Space[Any]]] = {
            "probe.position": make_box_space(POSITION_BOUND_M, 3),
            "probe.orientation": make_box_space(1.0 + 1e-9, 4),
            "probe.velocity": make_box_space(SPEED_BOUND_M_PER_S, 3),
            "force": make_box_space(force * (1.0 + 1e-9), 3),
            "torque": make_box_space(torque * (1.0 + 1e-9), 3),
            "contact.mode": spaces.Discrete(3),
            "contact.penetration": make_box_space(DEPTH_BOUND_M),
            "contact.normal": make_box_space(1.0 + 1e-9, 3),
            "contact.spin": make_box_space(SPIN_BOUND_RAD),
        }
        self._readings: Final = [
            (name, _find_columns(NAMED[name]), np.int64 if isinstance(space, spaces.Discrete) else np.array)
            for name, space in self._fields.items()
        ]
        goal = {"goal.position": make_box_space(POSITION_BOUND_M, 3), "goal.orientation": make_box_space(1.0 + 1e-9, 4)}
        self.observation_space = spaces.Dict({**self._fields, **goal})
        self._start()

    def reward(self, records: Records) -> float:
        """Return the negative mean distance (N) of the normal force from the goal, from the records of a step."""
        return -float(np.abs(records["contact.normal_force"] - self.setup.goal_n).mean())

    def is_terminated(self, records: Records) -> bool:
        """Return False: a step never ends the task."""
        return False

    def _compute_velocities(self, action: Array) -> Array:
        velocities: Array = (action * self._scale)[None]
        return velocities

    def _run(self, goals: Array) -> Records:
        records: list[Records] = list(super()._run(goals).values())
        return records[0]

    def _observe(self, records: Records) -> Observation:
        last = np.asarray(records)[-1]
        observation: Observation = {name: kind(last[columns]) for name, columns, kind in self._readings}
        observation["goal.position"] = self._goals[0, :3].copy()
        observation["goal.orientation"] = self._goals[0, 3:].copy()
        return observation


def _find_columns(field: Field) -> int | slice:
    """Return the index of a field in a row of a record."""
    return field.at if field.size == 1 else slice(field.at, field.at + field.size)


gymnasium.register(NAME, entry_point=Touch)
