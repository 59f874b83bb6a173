"""A fingertip to learn with: an environment of Gymnasium's over the contact and a simulated hand, compiled, no clock.

    import gymnasium
    import softfinger.server.bridges.environment        # makes the name known

    env = gymnasium.make("softfinger/Touch-v0", scene="sphere")

The agent leads the hand: where it wants the fingertip to be, and how turned. Its spring and damper pull the handle
there, as far as the contact lets it, tick by tick as in the daemon with the device `simulated`.
"""

from __future__ import annotations

from collections.abc import Mapping
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

    home_m: tuple[float, float, float] = (0.0, 0.0, 0.015)
    reach_m: float = 0.03
    speed_m_per_s: float = 0.05
    turn_rad_per_s: float = 2.0
    step_ticks: int = 20
    episode_steps: int = 200
    goal_n: float = 0.5
    rate_hz: float = 1000.0
    hand: Hand = field(default_factory=Hand)


class Touch(gymnasium.Env[Observation, Array]):
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

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012  (as the base class declares it)

    def __init__(self, scene: SceneSource = "paper-plane", setup: Setup | None = None, **changes: Any) -> None:
        self.setup: Final = setup or Setup(**changes)
        self.config: Final = load_scene(scene)
        if len(self.config.fingers) > 1:
            raise ConfigError(f"the scene has {len(self.config.fingers)} fingers: this environment has a single hand")
        guard = load_rig("simulated", {"guard.ramp_s": RAMP_S}).guard
        options = Options(position_m=self.setup.home_m, hand=self.setup.hand)
        self._device = simulation(options, self.setup.rate_hz)
        self._tuning = packed(make_tuning(self.config, guard))
        self._begin = begin(self._tuning.like.scene)
        self._dt = 1.0 / self.setup.rate_hz
        self._speeds = np.array([self.setup.speed_m_per_s] * 3 + [self.setup.turn_rad_per_s] * 3)
        self.action_space = spaces.Box(-1.0, 1.0, (6,), np.float64)
        force, torque = guard.force_max_n, guard.torque_max_nm

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

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """A new episode: hand and fingertip at home, no contact remembered. Nothing is drawn at random."""
        super().reset(seed=seed)
        self._start()
        settling = max(self.setup.step_ticks, round(RAMP_S * self.setup.rate_hz))
        records = self._run(np.tile(self._goal, (settling + 1, 1)))
        return self._observed(records), {"records": records}

    def step(self, action: Array) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Lead the hand for `step_ticks`; what is out of the action's range is brought into it."""
        velocity = self._speeds * np.clip(np.asarray(action, np.float64), -1.0, 1.0)
        records = self._run(self._way(velocity))
        self._steps += 1
        over = self._steps >= self.setup.episode_steps
        return self._observed(records), self.reward(records), self.terminated(records), over, {"records": records}

    def reward(self, records: Records) -> float:
        """Of a step, from its records: minus the mean distance (N) of the normal force from the goal."""
        return -float(np.abs(records["contact.normal_force"] - self.setup.goal_n).mean())

    def terminated(self, records: Records) -> bool:
        """Whether a step ended the task, from its records: never."""
        return False

    def _start(self) -> None:
        begin_bodies(self._tuning.like.scene, self._dt)
        self._memory, self._state = packed(self._begin), packed((self._device.state,))
        self._line = np.zeros(LINE_SIZE)
        self._goal: Array = np.array([*self.setup.home_m, 1.0, 0.0, 0.0, 0.0])
        self._ticks = self._steps = 0

    def _way(self, velocity: Array) -> Array:
        """Goals (ticks + 1, 7) from where it is, straight and evenly turned."""
        home, reach = np.array(self.setup.home_m), self.setup.reach_m
        times = self._dt * np.arange(self.setup.step_ticks + 1)[:, None]
        places = np.clip(self._goal[:3] + times * velocity[:3], home - reach, home + reach)
        turns = times * velocity[3:]
        return np.hstack([places, _turned(turns, self._goal[3:])])

    def _run(self, goals: Array) -> Records:
        """Records of the ticks that lead along goals (ticks + 1, 7), the first of which is where it is."""
        records = np.zeros((len(goals) - 1, 1, RECORD_SIZE))
        intention = Intention(float(len(goals)), 0.0, (0.0, 0.0, 0.0), 0.0, 0.0)
        drive = Drive(intention, np.ascontiguousarray(goals).reshape(-1), self._line)
        # From tick 0 on, as the goals are numbered; what the first tick of all does is in the memory.
        hands = (Held(self._device.plant, drive),)
        record_ticks(self._tuning, self._memory, hands, self._state, self._dt, 0, records)
        check_bodies(self._tuning.like.scene)
        named = Records(records[:, 0])
        named["timestamp"][:] += self._ticks * self._dt
        records[:, 0, AT.tick] += self._ticks
        self._ticks += len(named)
        self._goal = goals[-1]
        return named

    def _observed(self, records: Records) -> Observation:
        last = records[-1]
        seen: Observation = {
            name: np.int64(last[name]) if isinstance(space, spaces.Discrete) else np.array(last[name])
            for name, space in self._fields.items()
        }
        return seen | {"goal.position": self._goal[:3].copy(), "goal.orientation": self._goal[3:].copy()}


def _turned(turns: Array, orientation: Array) -> Array:
    """Quaternions (n, 4): an orientation (4,) turned by rotation vectors (n, 3), world frame."""
    angles = np.linalg.norm(turns, axis=1, keepdims=True)
    w, v = np.cos(0.5 * angles), 0.5 * np.sinc(0.5 * angles / np.pi) * turns
    w0, v0 = orientation[0], orientation[1:]
    made = np.hstack([w * w0 - (v @ v0)[:, None], w * v0 + w0 * v + np.cross(v, v0)])
    unit: Array = made / np.linalg.norm(made, axis=1, keepdims=True)
    return unit


gymnasium.register(NAME, entry_point=Touch)
