"""Two fingertips to learn a grasp with: an environment of Gymnasium's on the scene `lift-a-box`.

    import gymnasium
    import softfinger.server.bridges.lift_environment    # makes the name known

    env = gymnasium.make("softfinger/Lift-v0")

The agent leads two hands as that of `environment.Touch` leads one; MuJoCo moves the box between them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from softfinger.config.load import SceneSource, load_rig, load_scene
from softfinger.drivers.simulated.options import Hand, Options, simulation
from softfinger.drivers.simulated.plant import LINE_SIZE, Drive, Intention
from softfinger.proxy.bodies import begin_bodies, check_bodies
from softfinger.proxy.kernels.jit.pack import packed
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.proxy.records import Records
from softfinger.server.bridges.environment import FAR_M, RAMP_S, Observation
from softfinger.server.loop.tick import begin
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.closed_loop import Held, record_ticks

Array = NDArray[np.float64]

NAME: Final = "softfinger/Lift-v0"
GONE_M: Final = 0.5
"""A box that is so far from where it stood is lost."""


@dataclass(frozen=True)
class LiftSetup:
    """What the environment is like, but for the scene.

    homes_m          (2, 3) m     where thumb and index finger begin, at rest
    reach_m          m            largest distance of a hand's goal from there, along each axis
    speed_m_per_s    m/s          of the goals, along each axis, at most
    step_ticks       ticks        of a step of the environment
    episode_steps    steps        until an episode is cut off
    goal_m           m            of the task: how far the box is to be lifted
    rate_hz          Hz           of the ticks
    hand                          that holds each handle, of an omega.6
    """

    homes_m: tuple[tuple[float, float, float], tuple[float, float, float]] = ((-0.04, 0.0, 0.02), (0.04, 0.0, 0.02))
    reach_m: float = 0.15
    speed_m_per_s: float = 0.1
    step_ticks: int = 20
    episode_steps: int = 200
    goal_m: float = 0.1
    rate_hz: float = 1000.0
    hand: Hand = field(default_factory=Hand)


class Lift(gymnasium.Env[Observation, Array]):
    """Two fingertips that are led to a body, and are to lift it.

    scene    what `load_scene` takes: with two fingers, and a [world] whose first moving body is to be lifted
    setup    the rest; keywords of `LiftSetup` may be given instead: Lift(goal_m=0.05)

    action       (6,) from -1 to 1, held for a step: velocity of the thumb's goal along x, y, z, then of the index
                 finger's, as shares of `speed_m_per_s`, world frame
    observation  position (3,) m of each fingertip, force (3,) N on each hand, where each goal is (3,) m, and the body's
                 position (3,) m and orientation (4,), at the end of the step
    reward       minus the distance (m) of the body's height from `goal_m` above where it stood
    info         "records": Records by finger, every tick of the step

    Terminated when the body is lost; truncated after `episode_steps`. Bodies that MuJoCo cannot simulate raise
    SafetyStop. For another task override `reward` and `terminated`.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  (as the base class declares it)

    def __init__(self, scene: SceneSource = "lift-a-box", setup: LiftSetup | None = None, **changes: Any) -> None:
        self.setup: Final = setup or LiftSetup(**changes)
        self.config: Final = load_scene(scene)
        self.fingers: Final = tuple(finger.name for finger in self.config.fingers)
        guard = load_rig("simulated", {"guard.ramp_s": RAMP_S}).guard
        rate = self.setup.rate_hz
        self._devices = [
            simulation(Options(position_m=home, hand=self.setup.hand), rate) for home in self.setup.homes_m
        ]
        self._tuning = packed(make_tuning(self.config, guard))
        self._dt = 1.0 / rate
        bodies: Any = self._tuning.like.scene.bodies
        self.world: Final = bodies.block.owner
        self._body = self.world.moving[0]
        self.action_space = spaces.Box(-1.0, 1.0, (6,), np.float64)
        far, force = spaces.Box(-FAR_M, FAR_M, (3,), np.float64), guard.force_max_n * (1.0 + 1e-9)
        parts: dict[str, spaces.Space[Any]] = {"body.position": far, "body.orientation": _box(1.0 + 1e-9, 4)}
        for name in self.fingers:
            parts |= {f"{name}.position": far, f"{name}.force": _box(force, 3), f"{name}.goal": far}
        self.observation_space = spaces.Dict(parts)
        self._start()

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """A new episode: hands at home, bodies where the model has them. Nothing is drawn at random."""
        super().reset(seed=seed)
        self._start()
        settling = max(self.setup.step_ticks, round(RAMP_S * self.setup.rate_hz))
        records = self._run(np.tile(self._goals, (settling + 1, 1, 1)))
        return self._observed(records), {"records": records}

    def step(self, action: Array) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Lead the hands for `step_ticks`; what is out of the action's range is brought into it."""
        velocity = self.setup.speed_m_per_s * np.clip(np.asarray(action, np.float64), -1.0, 1.0).reshape(2, 3)
        times = self._dt * np.arange(self.setup.step_ticks + 1)[:, None, None]
        homes, reach = np.array(self.setup.homes_m), self.setup.reach_m
        records = self._run(np.clip(self._goals + times * velocity, homes - reach, homes + reach))
        self._steps += 1
        over = self._steps >= self.setup.episode_steps
        return self._observed(records), self.reward(records), self.terminated(records), over, {"records": records}

    def reward(self, records: Mapping[str, Records]) -> float:
        """Of a step, from its records and `world`: minus the distance (m) of the body from its goal's height."""
        return -abs(float(self.world.data.xpos[self._body, 2] - self._stood[2]) - self.setup.goal_m)

    def terminated(self, records: Mapping[str, Records]) -> bool:
        """Whether a step ended the task, from its records and `world`: the body is lost."""
        return bool(np.linalg.norm(self.world.data.xpos[self._body] - self._stood) > GONE_M)

    def _start(self) -> None:
        scene = self._tuning.like.scene
        begin_bodies(scene, self._dt)
        self._memory, self._states = packed(begin(scene)), packed(tuple(each.state for each in self._devices))
        self._lines = [np.zeros(LINE_SIZE) for _ in self._devices]
        self._goals: Array = np.array(self.setup.homes_m)
        self._stood = self.world.data.xpos[self._body].copy()
        self._ticks = self._steps = 0

    def _run(self, goals: Array) -> dict[str, Records]:
        """Records of the ticks that lead along goals (ticks + 1, 2, 3), the first of which is where they are."""
        count = len(goals) - 1
        upright = np.tile([1.0, 0.0, 0.0, 0.0], (count + 1, 1))
        intention = Intention(float(count + 1), 0.0, (0.0, 0.0, 0.0), 0.0, 0.0)
        hands = tuple(
            Held(device.plant, Drive(intention, np.hstack([goals[:, place], upright]).reshape(-1), line))
            for place, (device, line) in enumerate(zip(self._devices, self._lines, strict=True))
        )
        records = np.zeros((count, len(hands), RECORD_SIZE))
        record_ticks(self._tuning, self._memory, hands, self._states, self._dt, 0, records)
        check_bodies(self._tuning.like.scene)
        records[:, :, AT.timestamp] += self._ticks * self._dt
        records[:, :, AT.tick] += self._ticks
        self._ticks += count
        self._goals = goals[-1]
        return {name: Records(np.ascontiguousarray(records[:, at])) for at, name in enumerate(self.fingers)}

    def _observed(self, records: Mapping[str, Records]) -> Observation:
        data = self.world.data
        seen: Observation = {
            "body.position": np.clip(data.xpos[self._body], -FAR_M, FAR_M),
            "body.orientation": data.xquat[self._body].copy(),
        }
        for place, (name, rows) in enumerate(records.items()):
            last = rows[-1]
            seen[f"{name}.position"], seen[f"{name}.force"] = np.array(last["probe.position"]), np.array(last["force"])
            seen[f"{name}.goal"] = self._goals[place].copy()
        return seen


def _box(most: float, size: int) -> spaces.Box:
    return spaces.Box(-most, most, (size,), np.float64)


gymnasium.register(NAME, entry_point=Lift)
