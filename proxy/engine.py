"""The contact model for Python: load a scene, step poses one by one or a whole array, get typed results."""

from __future__ import annotations

from pathlib import Path
from typing import Final, NamedTuple

import numba
import numpy as np
from numpy.typing import ArrayLike, NDArray

from softfinger.config import schema
from softfinger.config.errors import HapticError
from softfinger.config.load import load_scene
from softfinger.proxy.kernels.jit import entry
from softfinger.proxy.kernels.model import Contact, Scene, State
from softfinger.proxy.kernels.pack import flatten, pack, unpack
from softfinger.proxy.kernels.record import write_contact
from softfinger.proxy.kernels.rotations import normalize
from softfinger.proxy.kernels.step import step
from softfinger.proxy.scene import build_scene, start_state
from softfinger.proxy.state import CAUSE_NAMES, POSITION_MAX_M, RECORD_SIZE

Array = NDArray[np.float64]


DT_MIN_S: Final = 1e-9
DT_MAX_S: Final = 1e3
"""Time steps far beyond any servo's; within them no quotient of the step overflows."""


class PoseError(HapticError):
    """A pose, or a time step, that no probe can have."""


class Step(NamedTuple):
    """One tick's outcome. Vectors (3,) float64 in the world frame; `finger_point` in the fingertip frame."""

    mode: int
    object: int
    cause: str
    velocity: Array
    proxy_position: Array
    penetration: float
    point: Array
    normal: Array
    finger_point: Array
    rolled: float
    spin: float
    normal_force: float
    tangential_force: float
    force: Array
    torque: Array


@entry
def step_once(scene: Scene, values: Array, start: State, state_values: Array, pose: Array, dt: float) -> Contact:
    """One step with scene and state in flat arrays; returns the Contact."""
    parameters = unpack(scene, values)
    state = unpack(start, state_values)
    position, orientation = (pose[0], pose[1], pose[2]), normalize((pose[3], pose[4], pose[5], pose[6]))
    state, contact = step(parameters, state, position, orientation, dt)
    pack(state_values, state)
    return contact


@entry
def step_many(
    scene: Scene,
    values: Array,
    start: State,
    state_values: Array,
    poses: Array,
    dt: float,
    first_tick: int,
    records: Array,
) -> None:
    """One step for each row of `poses` (n, 7), leaving a record each in `records` (n, RECORD_SIZE)."""
    parameters = unpack(scene, values)
    state = unpack(start, state_values)
    for i in range(poses.shape[0]):
        pose = poses[i]
        position, orientation = (pose[0], pose[1], pose[2]), normalize((pose[3], pose[4], pose[5], pose[6]))
        state, contact = step(parameters, state, position, orientation, dt)
        row = records[i]
        row[0] = (first_tick + i) * dt
        write_contact(row, first_tick + i, dt, position, orientation, contact, contact.force, contact.torque)
    pack(state_values, state)


class Engine:
    """A contact between one fingertip and a scene, advanced by poses.

    scene     a validated scene, or the path or shipped name of a scene file
    rate_hz   nominal tick rate; the default time step is its inverse

    The first step compiles the scene's kernels unless an earlier run left them in the cache.
    """

    def __init__(self, scene: schema.Scene | str | Path, rate_hz: float = 1000.0) -> None:
        config = scene if isinstance(scene, schema.Scene) else load_scene(scene)
        self.scene: Scene = build_scene(config)
        self.dt = 1.0 / rate_hz
        self._values = flatten(self.scene)
        self._start = start_state(self.scene)
        self._state = flatten(self._start)
        self._tick = 0

    def reset(self) -> None:
        """Forget the contact: the next step is the first."""
        self._state = flatten(self._start)
        self._tick = 0

    def tune(self, scene: schema.Scene) -> None:
        """Change parameters and keep the contact; ValueError if the scene has other parts than the compiled one."""
        tree = build_scene(scene)
        if numba.typeof(tree) != numba.typeof(self.scene):
            raise ValueError("the new scene has other parts than the one compiled: make another engine")
        self.scene, self._values = tree, flatten(tree)

    def step(self, position: ArrayLike, orientation: ArrayLike, dt: float | None = None) -> Step:
        """Advance by one pose.

        position     (3,) m  fingertip centre, world
        orientation  (4,) 1  quaternion w, x, y, z, fingertip to world; normalised here
        dt           s       time since the last pose, default the nominal one

        Raises PoseError for a pose that is not finite or out of range, and for a dt that no servo has.
        """
        pose = np.concatenate([np.asarray(position, np.float64), np.asarray(orientation, np.float64)])
        poses = check_poses(pose.reshape(1, -1))
        c = step_once(self.scene, self._values, self._start, self._state, poses[0], self._check_dt(dt))
        self._tick += 1
        return Step(
            mode=int(c.mode),
            object=int(c.object),
            cause=CAUSE_NAMES[int(c.cause)],
            velocity=np.array(c.velocity),
            proxy_position=np.array(c.center),
            penetration=c.penetration,
            point=np.array(c.point),
            normal=np.array(c.normal),
            finger_point=np.array(c.finger_point),
            rolled=c.rolled,
            spin=c.spin,
            normal_force=c.normal_force,
            tangential_force=c.tangential_force,
            force=np.array(c.force),
            torque=np.array(c.torque),
        )

    def run(self, poses: ArrayLike, dt: float | None = None) -> Array:
        """Advance by many poses (n, 7), rows x, y, z, qw, qx, qy, qz; returns records (n, RECORD_SIZE).

        Columns are those of `softfinger.proxy.state`; the timestamp is the tick times dt, and the
        fields of servo and device are 0. Raises PoseError as `step`.
        """
        checked = check_poses(np.asarray(poses, np.float64))
        records = np.zeros((len(checked), RECORD_SIZE))
        step_many(self.scene, self._values, self._start, self._state, checked, self._check_dt(dt), self._tick, records)
        self._tick += len(checked)
        return records

    def _check_dt(self, dt: float | None) -> float:
        if dt is None:
            return self.dt
        if not (dt == 0.0 or DT_MIN_S <= dt <= DT_MAX_S):
            raise PoseError(f"dt = {dt}: a time step is 0 or from {DT_MIN_S:g} to {DT_MAX_S:g} s")
        return float(dt)


def check_poses(poses: Array) -> Array:
    """Poses (n, 7), contiguous; raises PoseError naming the first row that cannot be used."""
    if poses.ndim != 2 or poses.shape[1] != 7:
        raise PoseError(f"poses of shape {poses.shape}: expected (n, 7), rows x, y, z, qw, qx, qy, qz")
    bad = ~np.isfinite(poses).all(axis=1)
    if bad.any():
        row = int(bad.argmax())
        raise PoseError(f"pose {row} is {poses[row].tolist()}: every number must be finite")
    bad = (np.abs(poses[:, :3]) > POSITION_MAX_M).any(axis=1)
    if bad.any():
        row = int(bad.argmax())
        raise PoseError(f"pose {row} is at {poses[row, :3].tolist()} m: a coordinate is at most {POSITION_MAX_M:g} m")
    norms = np.linalg.norm(poses[:, 3:], axis=1)
    bad = ~((norms >= 1e-6) & (norms <= 1e6))
    if bad.any():
        row = int(bad.argmax())
        raise PoseError(f"pose {row} has the quaternion {poses[row, 3:].tolist()}: its norm must be from 1e-6 to 1e6")
    return np.ascontiguousarray(poses)
