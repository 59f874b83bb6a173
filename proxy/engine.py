"""Contact model for Python: load a scene, step single poses or an array of poses, and get typed results.

The modules that read and build a scene are imported with the first scene: that takes as long as the kernels.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, Final, overload

import numba
import numpy as np
from numba import types
from numpy import ndarray
from numpy.typing import ArrayLike, NDArray

from softfinger.config.arguments import check_text, describe_refusal, to_number
from softfinger.config.errors import ConfigError
from softfinger.proxy.kernels.jit.decorators import PLAIN, entry
from softfinger.proxy.kernels.jit.pack import flatten, pack, unpack
from softfinger.proxy.kernels.jit.tuples import map_each, rows_of
from softfinger.proxy.kernels.model import Scene, State
from softfinger.proxy.kernels.query.bodies import step_bodies
from softfinger.proxy.kernels.record_writer import unpack_poses, write_surfaces, write_timed_contact
from softfinger.proxy.kernels.step import step
from softfinger.proxy.pose_checks import PoseError, check_poses, stack_poses
from softfinger.proxy.record import POSITION_MAX_M, RECORD_SIZE
from softfinger.proxy.records import Records
from softfinger.proxy.step_result import Step

if TYPE_CHECKING:
    from softfinger.config import schema
    from softfinger.config.load import SceneSource
    from softfinger.proxy.bodies import RigidBodies

Array = NDArray[np.float64]

DT_MIN_S: Final = 1e-9
DT_MAX_S: Final = 1e3
"""Range of time steps, far beyond that of any servo; within it no division by the step overflows."""
NEAR_M2: Final = POSITION_MAX_M * POSITION_MAX_M
"""Squared distance from the origin below which no coordinate is out of range."""


@entry
def step_many(
    scene: Any,
    values: Array,
    start: Any,
    state_values: Array,
    poses: Array,
    dt: float,
    first_tick: int,
    records: Array,
) -> None:
    """Run one step for each of n ticks in `poses` (n, fingers, 7), and fill their `records` (n, fingers, RECORD_SIZE).

    scene, start  types of a Scene and its State, with the leaves `values` and `state_values`
    """
    parameters = unpack(scene, values)
    state = unpack(start, state_values)
    for i in range(poses.shape[0]):
        probes = unpack_poses(rows_of(parameters.fingers, poses[i], 0))
        state, contacts = step(parameters, state, probes, dt)
        rows = rows_of(parameters.fingers, records[i], 0)
        map_each(write_timed_contact, (contacts, rows, probes), first_tick + i, dt)
        write_surfaces(state.world.surfaces, rows)
        step_bodies(parameters.bodies)
    pack(state_values, state)


def compile_steps(scene: Scene, begin: State) -> Callable[..., None]:
    """Return `step_many` compiled for scenes and states of these types; it ignores the arguments `scene` and `start`.

    numba's dispatcher would determine the types of both trees number by number on each call, in a hundred microseconds.
    """
    if PLAIN:
        return lambda _scene, values, _start, *rest: step_many(scene, values, begin, *rest)
    like, start = (types.TypeRef(numba.typeof(tree)) for tree in (scene, begin))
    leaves, table = types.float64[::1], types.float64[:, :, ::1]
    kernel: Any = step_many
    compiled: Callable[..., None] = kernel.compile(
        (like, leaves, start, leaves, table, types.float64, types.int64, table)
    )
    return compiled


class Engine:
    """Contact between a scene and its fingertips, advanced pose by pose.

    The first step compiles the scene's kernels unless they are in the cache from an earlier run.

    Parameters
    ----------
    scene
        Validated scene, or anything that `load_scene` accepts: path of a file, name of a shipped scene, or mapping.
    rate_hz
        Nominal tick rate, Hz; the default time step is its inverse.

    Raises
    ------
    ConfigError
        If the scene cannot be used, or the rate is out of range.

    Examples
    --------
    >>> from softfinger import Engine
    >>> engine = Engine("paper-plane")
    >>> touch = engine.step([0.0, 0.0, 0.0095], [1.0, 0.0, 0.0, 0.0])   # 0.5 mm into the plane z = 0, radius 10 mm
    >>> touch.force.round(6).tolist(), touch.mode.name, touch.cause
    ([0.0, 0.0, 0.5], 'ROLLING', 'touch')
    >>> engine.set("object.table.material.stiffness_n_per_m", 500.0)
    >>> engine.step([0.0, 0.0, 0.0095], [1.0, 0.0, 0.0, 0.0]).force.round(6).tolist()
    [0.0, 0.0, 0.25]
    >>> engine.get("object.table.material.stiffness_n_per_m")
    500.0
    """

    def __init__(self, scene: SceneSource, rate_hz: float = 1000.0) -> None:
        from softfinger.config.load import load_scene
        from softfinger.proxy.scene import build_scene, start_state

        self.config = load_scene(scene)
        """Validated scene, including the changes by `set`."""
        self.scene: Scene = build_scene(self.config)
        self.fingers: Final = tuple(finger.name for finger in self.config.fingers)
        """Names of the fingers; the finger of [fingertip] has the name ""."""
        rate = to_number(rate_hz)
        if not 1.0 / DT_MAX_S <= rate <= 1.0 / DT_MIN_S:
            allowed = f"a number from {1 / DT_MAX_S:g} to {1 / DT_MIN_S:g} Hz"
            raise ConfigError(describe_refusal("rate_hz", rate_hz, allowed))
        self.dt = 1.0 / rate
        self._begin = start_state(self.scene)
        self._start: Array = flatten(self._begin)
        self._state: Array
        self.reset()
        self._make_buffers()

    def _make_buffers(self) -> None:
        """Allocate the arguments of the kernel, and the arrays with its results."""
        self._has_several, self._has_bodies = len(self.fingers) > 1, self.scene.bodies is not None
        self._values = flatten(self.scene)
        self._advance: Callable[..., None] | None = None
        self._poses, self._records = (np.zeros((1, 1, size)) for size in (7, RECORD_SIZE))
        self._pose, self._record = self._poses[0, 0], self._records[0, 0]
        self._write_pose = partial(struct.Struct("7d").pack_into, memoryview(self._pose).cast("B"), 0)

    def __repr__(self) -> str:
        objects = ", ".join(obj.name for obj in self.config.object)
        fingers = f"fingers {', '.join(self.fingers)}; " if len(self.fingers) > 1 else ""
        return f"<Engine: {fingers}objects {objects}; {1.0 / self.dt:g} Hz, after {self._tick} ticks>"

    def __getstate__(self) -> dict[str, Any]:
        """Return the state from which a copy continues with the same bits: scene, contact, bodies of a [world]."""
        names = ("config", "scene", "fingers", "dt", "_begin", "_start", "_state", "_tick")
        return {name: vars(self)[name] for name in names}

    def __setstate__(self, state: Mapping[str, Any]) -> None:
        vars(self).update(state)
        start = flatten(self._begin)
        is_address = start.view(np.int64) != self._start.view(np.int64)  # memory of the copy is at other addresses
        self._start, self._state = start, np.where(is_address, start, self._state)
        self._make_buffers()

    def _repr_html_(self) -> str:
        """Return a table of the objects, for notebooks."""
        from html import escape

        rows = "".join(
            f"<tr><th>{escape(obj.name)}</th><td>{escape(type(obj).__name__.lower())}</td></tr>"
            for obj in self.config.object
        )
        return f"<p>{escape(repr(self).strip('<>'))}</p><table>{rows}</table>"

    def reset(self) -> None:
        """Clear the contact and reset the bodies of a [world]: the next step is the first."""
        self._state = self._start.copy()
        self._tick = 0
        if self.scene.bodies is not None:
            self._world.begin(self.dt)

    @property
    def model(self) -> Any:
        """MuJoCo's MjModel of the scene's [world]. Raises ConfigError in a scene without [world]."""
        return self._world.model

    @property
    def data(self) -> Any:
        """MuJoCo's MjData of the scene's [world]. Raises ConfigError in a scene without [world]."""
        return self._world.data

    @property
    def _world(self) -> RigidBodies:
        if self.scene.bodies is None:
            raise ConfigError("the scene has no [world], so there is no model and no data")
        owner: RigidBodies = self.scene.bodies.block.owner
        return owner

    @overload
    def set(self, changes: str, value: Any) -> None: ...

    @overload
    def set(self, changes: Mapping[str, Any]) -> None: ...

    def set(self, changes: str | Mapping[str, Any], value: Any = None) -> None:
        """Change parameters and preserve the contact. Nothing is compiled.

        Parameters
        ----------
        changes
            Dotted path of one parameter, such as object.table.material.stiffness_n_per_m or fingertip.radius_m; or a
            mapping with several paths and values, of which all or none are applied. `load_scene` and the command
            set_params use the same paths.
        value
            Value of a single parameter.

        Raises
        ------
        ConfigError
            If a value is out of range, a path does not exist, or a change requires another compiled model.
        """
        from softfinger.config.load import apply_overrides
        from softfinger.proxy.scene import describe_model_change

        values = {changes: value} if isinstance(changes, str) else changes
        if not self._take(apply_overrides(self.config, values, "set")):
            raise ConfigError(f"set: {describe_model_change(self.config, values)}: create another Engine")

    def get(self, path: str) -> Any:
        """Return the present value of a parameter.

        Parameters
        ----------
        path
            Dotted path as for `set`; that of a table, such as object.table.material, returns a dictionary.

        Raises
        ------
        ConfigError
            If the scene has no value there.
        """
        from softfinger.config.load import describe
        from softfinger.config.overrides import find_value, to_indexed_key

        mapping = describe(self.config)
        check_text(path, "path", "object.table.material")
        key = to_indexed_key(mapping, path)
        try:
            table = find_value(mapping, key.rpartition(".")[0]) if "." in key else mapping
            value = find_value(mapping, key) if isinstance(table, dict | list) else None
        except (IndexError, ValueError):
            value = None
        if value is None:
            raise ConfigError(f"get: the scene has no value at {path!r}")
        return value

    def tune(self, scene: schema.Scene) -> None:
        """Take the parameters from another scene and preserve the contact.

        Raises
        ------
        ConfigError
            If this is no scene, or one with other parts than the compiled one.
        """
        from softfinger.config import schema

        if not isinstance(scene, schema.Scene):
            raise ConfigError(describe_refusal("scene", scene, "a Scene, as `load_scene` returns it"))
        if not self._take(scene):
            raise ConfigError("the new scene has other parts than the compiled one: create another Engine")

    def _take(self, config: schema.Scene) -> bool:
        """Take the parameters of a scene; return False if it has other parts than the compiled one."""
        from softfinger.proxy.scene import build_scene, has_same_model

        tree = build_scene(config, self.scene)
        if not has_same_model(tree, self.scene):
            return False
        self.config, self.scene, self._values = config, tree, flatten(tree)
        if PLAIN:  # it refers to the arrays of its scene; compiled code reads their addresses from the values
            self._advance = None
        return True

    def step(self, position: ArrayLike, orientation: ArrayLike, dt: float | None = None) -> Step:
        """Advance by one pose, in a scene with one finger.

        Parameters
        ----------
        position
            (3,) m, fingertip centre, world frame.
        orientation
            (4,) quaternion w, x, y, z, fingertip to world; normalised here.
        dt
            Time since the last pose, s; by default the nominal one.

        Raises
        ------
        PoseError
            If the pose is not finite or out of range, `dt` is out of range, or the scene has several fingers.
        SafetyStop
            If the bodies of a [world] have failed.
        """
        if self._has_several:
            raise self._make_several_error()
        try:
            # Numbers are written in a third of the time that assignments to arrays take.
            centre: Any = position.tolist() if isinstance(position, ndarray) else position
            wxyz: Any = orientation.tolist() if isinstance(orientation, ndarray) else orientation
            x, y, z = centre
            a, b, c, d = wxyz
            self._write_pose(x, y, z, a, b, c, d)
            # Skip the check, 20 us, of a usable pose.
            is_usable = x * x + y * y + z * z < NEAR_M2 and 0.5 < a * a + b * b + c * c + d * d < 2.0
        except (TypeError, ValueError, OverflowError, struct.error):
            raise PoseError(
                f"position {position!r} and orientation {orientation!r}: must be 3 numbers (m) and 4 (w, x, y, z)"
            ) from None
        if not is_usable:
            check_poses(self._poses[0])
        advance = self._advance or self._compile()
        dt = self.dt if dt is None else self._check_dt(dt)
        advance(None, self._values, None, self._state, self._poses, dt, self._tick, self._records)
        self._tick += 1
        if self._has_bodies:
            self._check_bodies()
        return Step(self._record.copy())

    @overload
    def run(self, poses: Mapping[str, ArrayLike], dt: float | None = None) -> dict[str, Records]: ...

    @overload
    def run(self, poses: ArrayLike, dt: float | None = None) -> Records: ...

    def run(self, poses: ArrayLike | Mapping[str, ArrayLike], dt: float | None = None) -> Records | dict[str, Records]:
        """Advance by many poses.

        Parameters
        ----------
        poses
            (n, 7), rows x, y, z, qw, qx, qy, qz; with several fingers a mapping from their names to arrays of equal
            length.
        dt
            Time step, s; by default the nominal one.

        Returns
        -------
        Records or dict[str, Records]
            (n, RECORD_SIZE), with the fields of `softfinger.proxy.record` by name; for a mapping a dictionary by finger
            name. The timestamp is the tick times dt, and the fields of servo and device are 0.

        Raises
        ------
        PoseError
            If a pose or `dt` is out of range, or the poses do not match the scene's fingers.
        SafetyStop
            If the bodies of a [world] have failed.
        """
        is_by_finger = isinstance(poses, Mapping)
        if not is_by_finger and len(self.fingers) > 1:
            raise self._make_several_error()
        poses_by_finger: Mapping[str, Any] = poses if isinstance(poses, Mapping) else {self.fingers[0]: poses}
        together = stack_poses(poses_by_finger, self.fingers)
        records = np.zeros((*together.shape[:2], RECORD_SIZE))
        dt = self.dt if dt is None else self._check_dt(dt)
        advance = self._advance or self._compile()
        advance(None, self._values, None, self._state, together, dt, self._tick, records)
        self._tick += len(together)
        if self._has_bodies:
            self._check_bodies()
        by_finger = {name: Records(np.ascontiguousarray(records[:, at])) for at, name in enumerate(self.fingers)}
        return by_finger if is_by_finger else by_finger[self.fingers[0]]

    def _check_bodies(self) -> None:
        if (failure := self._world.failure) is not None:
            raise failure

    def _compile(self) -> Callable[..., None]:
        self._advance = compile_steps(self.scene, self._begin)
        return self._advance

    def _make_several_error(self) -> PoseError:
        return PoseError(
            f"the scene has the fingers {', '.join(self.fingers)}: pass `run` the poses of each by its name"
        )

    def _check_dt(self, dt: float) -> float:
        step_s = to_number(dt)
        if not (step_s == 0.0 or DT_MIN_S <= step_s <= DT_MAX_S):
            raise PoseError(describe_refusal("dt", dt, f"0 or a number from {DT_MIN_S:g} to {DT_MAX_S:g} s"))
        if self.scene.bodies is not None and step_s != self.dt:
            raise PoseError(f"dt = {step_s}: the bodies of [world] advance by {self.dt:g} s in each tick")
        return step_s
