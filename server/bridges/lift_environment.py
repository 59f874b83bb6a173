"""Gymnasium environment of a grasp with two fingertips, on the scene `lift-a-box`.

    import gymnasium
    import softfinger.server.bridges.lift_environment    # registers the name

    env = gymnasium.make("softfinger/Lift-v0")

The agent leads two hands like the single one in `environment.Touch`; MuJoCo moves the box between them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from softfinger.config.errors import ConfigError
from softfinger.config.load import SceneSource
from softfinger.drivers.simulated.options import Hand
from softfinger.proxy.records import Records
from softfinger.server.bridges.led_hands import (
    POSITION_BOUND_M,
    LedHands,
    Observation,
    Point,
    gymnasium,
    make_box_space,
    spaces,
)

NAME: Final = "softfinger/Lift-v0"
LOST_DISTANCE_M: Final = 0.5
"""A box farther than this from its initial position is lost."""


@dataclass(frozen=True)
class LiftSetup:
    """Parameters of the environment, except the scene.

    homes_m          (2, 3) m     initial positions of thumb and index finger, at rest
    reach_m          m            largest distance of a hand's goal from there, along each axis
    speed_m_per_s    m/s          largest speed of the goals, along each axis
    step_ticks       ticks        of a step of the environment
    episode_steps    steps        until an episode is truncated
    goal_m           m            target of the task: height by which to lift the box
    rate_hz          Hz           of the ticks
    hand                          impedance of each hand, on the handle of an omega.6
    """

    homes_m: tuple[Point, Point] = ((-0.04, 0.0, 0.02), (0.04, 0.0, 0.02))
    reach_m: float = 0.15
    speed_m_per_s: float = 0.1
    step_ticks: int = 20
    episode_steps: int = 200
    goal_m: float = 0.1
    rate_hz: float = 1000.0
    hand: Hand = field(default_factory=Hand)


class Lift(LedHands):
    """Two fingertips that the agent leads to a body, to lift it.

    scene    as for `load_scene`: with two fingers, and a [world]; its first moving body is to be lifted
    setup    parameters; keywords of `LiftSetup` may be given instead: Lift(goal_m=0.05)

    action       (6,) from -1 to 1, constant during a step: velocity of the thumb's goal along x, y, z, then of the
                 index finger's, as fractions of `speed_m_per_s`, world frame
    observation  position (3,) m of each fingertip, force (3,) N on each hand, position of each goal (3,) m, and the
                 body's position (3,) m and orientation (4,), at the end of the step
    reward       negative distance (m) of the body's height from `goal_m` above its initial height
    info         "records": Records by finger, every tick of the step

    Terminated when the body is lost; truncated after `episode_steps`. Raises SafetyStop if MuJoCo cannot simulate the
    bodies. For another task override `reward` and `is_terminated`.
    """

    setup: LiftSetup

    def __init__(self, scene: SceneSource = "lift-a-box", setup: LiftSetup | None = None, **changes: Any) -> None:
        setup = setup or LiftSetup(**changes)
        super().__init__(scene, setup, setup.homes_m)
        self.fingers: Final = tuple(finger.name for finger in self.config.fingers)
        bodies: Any = self._loop.scene.bodies
        if bodies is None:
            raise ConfigError("the scene has no [world]: this environment needs a body that MuJoCo moves")
        self.world: Final = bodies.block.owner
        self._body = self.world.moving[0]
        position_space, force = make_box_space(POSITION_BOUND_M, 3), self._guard.force_max_n * (1.0 + 1e-9)
        parts: dict[str, spaces.Space[Any]] = {
            "body.position": position_space,
            "body.orientation": make_box_space(1.0 + 1e-9, 4),
        }
        for name in self.fingers:
            parts |= {
                f"{name}.position": position_space,
                f"{name}.force": make_box_space(force, 3),
                f"{name}.goal": position_space,
            }
        self.observation_space = spaces.Dict(parts)
        self._start()

    def reward(self, records: Mapping[str, Records]) -> float:
        """Return the negative distance (m) of the body from its goal height, from the records of a step and `world`."""
        return -abs(float(self.world.data.xpos[self._body, 2] - self._initial_position[2]) - self.setup.goal_m)

    def is_terminated(self, records: Mapping[str, Records]) -> bool:
        """Return True if the body is lost, from the records of a step and `world`."""
        return bool(np.linalg.norm(self.world.data.xpos[self._body] - self._initial_position) > LOST_DISTANCE_M)

    def _start(self) -> None:
        super()._start()
        self._initial_position = self.world.data.xpos[self._body].copy()

    def _observe(self, records: Mapping[str, Records]) -> Observation:
        data = self.world.data
        observation: Observation = {
            "body.position": np.clip(data.xpos[self._body], -POSITION_BOUND_M, POSITION_BOUND_M),
            "body.orientation": data.xquat[self._body].copy(),
        }
        for index, (name, rows) in enumerate(records.items()):
            last = rows[-1]
            observation[f"{name}.position"], observation[f"{name}.force"] = (
                np.array(last["probe.position"]),
                np.array(last["force"]),
            )
            observation[f"{name}.goal"] = self._goals[index, :3].copy()
        return observation


gymnasium.register(NAME, entry_point=Lift)
