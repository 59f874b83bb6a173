"""A fingertip to learn with: an environment of Gymnasium's over the contact and a simulated hand, compiled, no clock.

    import gymnasium
    import softfinger.server.bridges.environment        # makes the name known

    env = gymnasium.make("softfinger/Touch-v0", scene="sphere")

The agent leads the hand: where it wants the fingertip to be, and how turned. Its spring and damper pull the handle
there, as far as the contact lets it, tick by tick as in the daemon with the device `simulated`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config.errors import ConfigError
from softfinger.config.load import SceneSource, load_rig, load_scene
from softfinger.drivers.simulated.options import Hand, Options, simulation
from softfinger.drivers.simulated.plant import LINE_SIZE, Drive, Intention
from softfinger.proxy.bodies import begin_bodies, check_bodies
from softfinger.proxy.kernels.jit.pack import packed
from softfinger.proxy.record import AT, RECORD_SIZE
from softfinger.proxy.records import Records
from softfinger.server.loop.tick import begin
from softfinger.server.loop.tuning import make_tuning
from softfinger.server.offline.closed_loop import Held, record_ticks

try:
    import gymnasium
    from gymnasium import spaces
except ImportError as missing:
    raise ConfigError(f"gymnasium is not installed ({missing}): pip install 'softfinger[gymnasium]'") from missing

Array = NDArray[np.float64]
Observation = dict[str, Any]
Place = tuple[float, float, float]

NAME: Final = "softfinger/Touch-v0"
RAMP_S: Final = 0.01
"""The guard's, as short as it may be: over before the first step."""
FAR_M: Final = 1.0
FAST_M_PER_S: Final = 100.0
DEEP_M: Final = 0.1
MANY_RAD: Final = 1e3
"""Bounds of observations that nothing real comes near."""


@dataclass(frozen=True)
class Setup:
    """What an environment is like, but for the scene.

    home_m           (3,) m       where hand and fingertip begin, at rest
    reach_m          m            largest distance of the hand's goal from there, along each axis
    speed_m_per_s    m/s          of the goal, along each axis, at most
    turn_rad_per_s   rad/s        of the goal, about each axis of the world, at most
    step_ticks       ticks        of a step of the environment
    episode_steps    steps        until an episode is cut off
    goal_n           N            of the task: the normal force that is to be kept
    rate_hz          Hz           of the ticks
    hand                          that holds the handle of an omega.6
    """

    home_m: Place = (0.0, 0.0, 0.015)
    reach_m: float = 0.03
    speed_m_per_s: float = 0.05
    turn_rad_per_s: float = 2.0
    step_ticks: int = 20
    episode_steps: int = 200
    goal_n: float = 0.5
    rate_hz: float = 1000.0
    hand: Hand = field(default_factory=Hand)


class LedHands(gymnasium.Env[Observation, Array]):
    """Simulated hands that an agent leads, one for each finger of a scene. A subclass says what is seen and rewarded.

    scene     what `load_scene` takes; ConfigError where it has another number of fingers
    setup     the dataclass of the subclass
    homes_m   (3,) m of each hand, where it begins, at rest
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  (as the base class declares it)
    setup: Any

    def __init__(self, scene: SceneSource, setup: Any, homes_m: Sequence[Place]) -> None:
        self.setup, self.config = setup, load_scene(scene)
        if (count := len(self.config.fingers)) != len(homes_m):
            raise ConfigError(f"fingers of the scene: {count}; hands of this environment: {len(homes_m)}")
        self._guard = load_rig("simulated", {"guard.ramp_s": RAMP_S}).guard
        self._devices = [simulation(Options(position_m=home, hand=setup.hand), setup.rate_hz) for home in homes_m]
        self._tuning = packed(make_tuning(self.config, self._guard))
        self._homes, self._dt = np.array(homes_m), 1.0 / setup.rate_hz
        self._times = self._dt * np.arange(setup.step_ticks + 1)[:, None]
        self.action_space = spaces.Box(-1.0, 1.0, (6,), np.float64)

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """A new episode: hands at home, bodies where the model has them, no contact remembered. Nothing is random."""
        super().reset(seed=seed)
        self._start()
        settling = max(self.setup.step_ticks, round(RAMP_S * self.setup.rate_hz))
        records = self._run(np.tile(self._goals, (settling + 1, 1, 1)))
        return self._observed(records), {"records": records}

    def step(self, action: Array) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Lead the hands for `step_ticks`; what is out of the action's range is brought into it."""
        records = self._run(self._way(np.clip(np.asarray(action, np.float64), -1.0, 1.0)))
        self._steps += 1
        over = self._steps >= self.setup.episode_steps
        return self._observed(records), self.reward(records), self.terminated(records), over, {"records": records}

    def reward(self, records: Any) -> float:
        """Of a step, from its records."""
        raise NotImplementedError

    def terminated(self, records: Any) -> bool:
        """Whether a step ended the task, from its records."""
        raise NotImplementedError

    def _observed(self, records: Any) -> Observation:
        raise NotImplementedError

    def _start(self) -> None:
        scene = self._tuning.like.scene
        begin_bodies(scene, self._dt)
        self._memory, self._states = packed(begin(scene)), packed(tuple(each.state for each in self._devices))
        self._lines = [np.zeros(LINE_SIZE) for _ in self._devices]
        self._goals: Array = np.array([[*home, 1.0, 0.0, 0.0, 0.0] for home in self._homes])
        self._ticks = self._steps = 0

    def _way(self, action: Array) -> Array:
        """Goals (ticks + 1, hands, 7) from where they are, straight: along x, y, z of each hand in turn."""
        goals = np.tile(self._goals, (len(self._times), 1, 1))
        velocity = self.setup.speed_m_per_s * action[: 3 * len(self._homes)].reshape(-1, 3)
        led = self._goals[:, :3] + self._times[:, None] * velocity
        goals[:, :, :3] = np.clip(led, self._homes - self.setup.reach_m, self._homes + self.setup.reach_m)
        return goals

    def _run(self, goals: Array) -> Any:
        """Records by finger of the ticks that lead along goals (ticks + 1, hands, 7), the first of which is now."""
        intention = Intention(float(len(goals)), 0.0, (0.0, 0.0, 0.0), 0.0, 0.0)
        hands = tuple(
            Held(device.plant, Drive(intention, goals[:, place].reshape(-1), line))
            for place, (device, line) in enumerate(zip(self._devices, self._lines, strict=True))
        )
        records = np.zeros((len(goals) - 1, len(hands), RECORD_SIZE))
        # From tick 0 on, as the goals are numbered; what the first tick of all does is in the memory.
        record_ticks(self._tuning, self._memory, hands, self._states, self._dt, 0, records)
        check_bodies(self._tuning.like.scene)
        records[:, :, AT.timestamp] += self._ticks * self._dt
        records[:, :, AT.tick] += self._ticks
        self._ticks += len(records)
        self._goals = goals[-1]
        names = [finger.name for finger in self.config.fingers]
        return {name: Records(np.ascontiguousarray(records[:, place])) for place, name in enumerate(names)}


class Touch(LedHands):
    """A fingertip that is led to a scene's objects, for one finger.

    scene    what `load_scene` takes
    setup    the rest; keywords of `Setup` may be given instead: Touch("sphere", goal_n=1.0)

    action       (6,) from -1 to 1, held for a step: velocity of the hand's goal along x, y, z as a share of
                 `speed_m_per_s`, its turning about x, y, z as a share of `turn_rad_per_s`, world frame
    observation  a dict of arrays, with names and units of the telemetry at the step's last tick, and where the goal is
    reward       minus the mean distance (N) of the normal force from `goal_n` over the ticks of the step
    info         "records": Records (step_ticks, RECORD_SIZE), every tick of the step

    Never terminated; truncated after `episode_steps`. For another task override `reward` and `terminated`.

    >>> env = Touch("paper-plane", home_m=(0.0, 0.0, 0.0105))
    >>> first, _ = env.reset(seed=1)
    >>> for _ in range(20):
    ...     seen, reward, terminated, truncated, info = env.step(np.array([0.0, 0.0, -0.06, 0.0, 0.0, 0.0]))
    >>> int(seen["contact.mode"]), bool(seen["force"][2] > 0.1), len(info["records"])
    (1, True, 20)
    """

    setup: Setup

    def __init__(self, scene: SceneSource = "paper-plane", setup: Setup | None = None, **changes: Any) -> None:
        setup = setup or Setup(**changes)
        super().__init__(scene, setup, [setup.home_m])
        force, torque = self._guard.force_max_n, self._guard.torque_max_nm

        def box(most: float, *shape: int) -> spaces.Box:
            return spaces.Box(-most, most, shape, np.float64)

        self._fields: Final[dict[str, spaces.Space[Any]]] = {
            "probe.position": box(FAR_M, 3),
            "probe.orientation": box(1.0 + 1e-9, 4),
            "probe.velocity": box(FAST_M_PER_S, 3),
            "force": box(force * (1.0 + 1e-9), 3),
            "torque": box(torque * (1.0 + 1e-9), 3),
            "contact.mode": spaces.Discrete(3),
            "contact.penetration": box(DEEP_M),
            "contact.normal": box(1.0 + 1e-9, 3),
            "contact.spin": box(MANY_RAD),
        }
        goal = {"goal.position": box(FAR_M, 3), "goal.orientation": box(1.0 + 1e-9, 4)}
        self.observation_space = spaces.Dict({**self._fields, **goal})
        self._start()

    def reward(self, records: Records) -> float:
        """Of a step, from its records: minus the mean distance (N) of the normal force from the goal."""
        return -float(np.abs(records["contact.normal_force"] - self.setup.goal_n).mean())

    def terminated(self, records: Records) -> bool:
        """Whether a step ended the task, from its records: never."""
        return False

    def _way(self, action: Array) -> Array:
        goals = super()._way(action)
        goals[:, 0, 3:] = _turned(self._times * (self.setup.turn_rad_per_s * action[3:]), self._goals[0, 3:])
        return goals

    def _run(self, goals: Array) -> Records:
        records: list[Records] = list(super()._run(goals).values())
        return records[0]

    def _observed(self, records: Records) -> Observation:
        last = records[-1]
        seen: Observation = {
            name: np.int64(last[name]) if isinstance(space, spaces.Discrete) else np.array(last[name])
            for name, space in self._fields.items()
        }
        return seen | {"goal.position": self._goals[0, :3].copy(), "goal.orientation": self._goals[0, 3:].copy()}


def _turned(turns: Array, orientation: Array) -> Array:
    """Quaternions (n, 4): an orientation (4,) turned by rotation vectors (n, 3), world frame."""
    angles = np.linalg.norm(turns, axis=1, keepdims=True)
    w, v = np.cos(0.5 * angles), 0.5 * np.sinc(0.5 * angles / np.pi) * turns
    w0, v0 = orientation[0], orientation[1:]
    made = np.hstack([w * w0 - (v @ v0)[:, None], w * v0 + w0 * v + np.cross(v, v0)])
    unit: Array = made / np.linalg.norm(made, axis=1, keepdims=True)
    return unit


gymnasium.register(NAME, entry_point=Touch)
