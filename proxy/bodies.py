"""Rigid bodies of a scene's [world]: MuJoCo's model and data, and their addresses for the kernels.

Only this file uses `_address` of MuJoCo's objects, which is undocumented; tests/proxy/test_bodies.py checks it.
"""

from __future__ import annotations

import ctypes
from operator import attrgetter
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from softfinger.config import schema
from softfinger.config.errors import ConfigError, SafetyStop
from softfinger.config.mjcf import find_key_number, import_mujoco, load_library, read_model
from softfinger.config.mjcf_geoms import can_move
from softfinger.proxy.kernels import model as kernels
from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.kernels.jit.decorators import PLAIN
from softfinger.proxy.kernels.jit.rescue import RESCUE_ALIGNMENT, RESCUE_BYTES, jump_on_error, words_in
from softfinger.proxy.kernels.query import bodies as at

TIMESTEP_TOLERANCE: Final = 1e-6
"""Relative difference allowed between a period, in whole nanoseconds, and a model's timestep, in decimal seconds."""


class SimulationAddresses(ReadOnly):
    """Addresses of a simulation; a reference to it preserves the simulation's memory."""

    __slots__ = ("owner",)

    def __init__(self, words: Any, owner: RigidBodies) -> None:
        super().__init__(words)
        self.owner: Final = owner

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle the simulation: a copy has different addresses."""
        return attrgetter("block"), (self.owner,)


class RigidBodies:
    """World of MuJoCo: its `model` and `data`. Raises ConfigError for a model that cannot be simulated."""

    def __init__(self, world: schema.World) -> None:
        self.world: Final = world
        package = import_mujoco()
        self.model = read_model(world)
        # A divergence must be reported, not hidden by an automatic reset to the initial state.
        self.model.opt.disableflags |= package.mjtDisableBit.mjDSBL_AUTORESET
        self._key: Final = find_key_number(self.model, world)
        self.data: Final = package.MjData(self.model)
        self.moving: Final = [body for body in range(1, self.model.nbody) if can_move(self.model, body)]
        """Numbers of the bodies that can move; `names` are their names, or numbers of unnamed bodies."""
        self.names: Final = [self.model.body(body).name or str(body) for body in self.moving]
        self._fault: Final = np.zeros(2, np.int64)
        self._last: Final = (np.zeros_like(self.data.xpos), np.zeros_like(self.data.xquat))
        self._message = ""
        self._connect()

    def __getstate__(self) -> dict[str, Any]:
        """Return the state from which a copy continues with the same bits; MuJoCo pickles its data with the model."""
        fields = ("world", "data", "moving", "names", "_key", "_fault", "_last", "_message")
        return {name: vars(self)[name] for name in fields}

    def __setstate__(self, state: dict[str, Any]) -> None:
        vars(self).update(state, model=state["data"].model)
        self._connect()

    def _connect(self) -> None:
        """Look up MuJoCo's functions, route its errors to `rescue`, and collect the addresses for the kernels."""
        self._library = load_library(import_mujoco())
        if not PLAIN:  # calls of MuJoCo from Python still raise exceptions
            self._library.mju_setLogHandler.argtypes = (ctypes.c_void_p,)
            self._library.mju_setLogHandler(jump_on_error.address)
        self._memory = np.zeros(RESCUE_BYTES + RESCUE_ALIGNMENT, np.uint8)
        self._rescue = -(-self._memory.ctypes.data // RESCUE_ALIGNMENT) * RESCUE_ALIGNMENT
        self.block = SimulationAddresses(self._make_words(self._library), self)

    def _make_words(self, library: ctypes.CDLL) -> Any:
        data, words = self.data, np.zeros(at.BLOCK_SIZE, np.int64)
        counters = data.warning.number
        words[at.MODEL], words[at.DATA] = self.model._address, data._address
        words[at.FIRST_HALF], words[at.SECOND_HALF] = (
            ctypes.cast(function, ctypes.c_void_p).value or 0 for function in (library.mj_step1, library.mj_step2)
        )
        arrays = {
            at.POSITION: data.xpos,
            at.ORIENTATION: data.xquat,
            at.MASS_CENTER: data.xipos,
            at.WRENCH: data.xfrc_applied,
            at.WARNINGS: counters,
            at.VELOCITY: data.cvel,
            at.TREE_CENTER: data.subtree_com,
            at.TREE_ROOT: self.model.body_rootid,
            at.FAULT: self._fault,
            at.LAST_POSITION: self._last[0],
            at.LAST_ORIENTATION: self._last[1],
        }
        for word, array in arrays.items():
            words[word] = array.__array_interface__["data"][0]
        words[at.SUBSTEPS], words[at.MOVING] = self.world.substeps, len(self.moving)
        words[at.RESCUE] = self._rescue
        words[at.BUDGET_NS] = round(1e3 * (self.world.budget_us or 0.0))
        words[at.WARNING_COUNT], words[at.WARNING_BYTES] = len(counters), counters.strides[0]
        return words

    def step_half(self, half: int) -> bool:
        """Run half a step with MuJoCo's Python package, for kernels in plain Python. Return whether it failed."""
        package = import_mujoco()
        try:
            (package.mj_step1 if half == at.FIRST_HALF else package.mj_step2)(self.model, self.data)
        except package.FatalError as error:
            self._message = " ".join(str(error).split())
            return True
        return False

    @property
    def failure(self) -> SafetyStop | None:
        """Reason why the bodies have stopped, with MuJoCo's message and the remedy; None while they move."""
        fault = int(self._fault[0])
        if fault == at.NO_FAULT:
            return None
        text = f"[world] {self.world.model}: the bodies were released and no longer move"
        if fault == at.SLOW:
            return SafetyStop(
                f"{text}: most steps took longer than world.budget_us = {self.world.budget_us:g}; take fewer bodies or "
                "simpler geoms, raise the budget, or lower servo.rate_hz"
            )
        remedy = (
            "lower stiffness_n_per_m, or raise damping_ns_per_m or world.substeps; if its memory is full, add "
            '<size memory="..."/> to the model'
        )
        if fault == at.WARNED:
            counted = self.data.warning
            kind = int(np.flatnonzero(counted.number)[0])
            message = import_mujoco().mju_warningText(kind, counted.lastinfo[kind]).rstrip(". ")
        else:
            message = self._message or words_in(self._rescue)
        return SafetyStop(f"{text}: MuJoCo said: {message}: {remedy}")

    def kernel(self, attached: tuple[float, ...]) -> kernels.Bodies:
        """Return the kernels' Bodies, with `attached` as described there."""
        return kernels.Bodies(
            self.block, ReadOnly(np.array(self.moving, np.int64)), ReadOnly(np.array(attached)), float(len(attached))
        )

    def begin(self, period_s: float) -> None:
        """Reset all bodies to their initial poses, or to the keyframe, for ticks of `period_s`.

        Raises ConfigError if the model has another fixed time step, or if its initial state has no finite acceleration.
        """
        package = import_mujoco()
        step = self.model.opt.timestep * self.world.substeps
        fits = abs(step - period_s) <= TIMESTEP_TOLERANCE * period_s
        if not fits and self.world.timestep == "tick":
            self.model.opt.timestep = period_s / self.world.substeps
        elif not fits:
            raise ConfigError(
                f"{self.world.model}: its timestep of {self.model.opt.timestep:g} s, world.substeps = "
                f"{self.world.substeps} times, is not a tick of {period_s:g} s: write "
                f'<option timestep="{period_s / self.world.substeps:g}"/>, or take another rate, or world.timestep = '
                '"tick"'
            )
        self._fault[:] = 0
        self._message = ""
        try:
            package.mj_resetData(self.model, self.data)
            if self._key is not None:
                package.mj_resetDataKeyframe(self.model, self.data, self._key)
            package.mj_forward(self.model, self.data)
        except package.FatalError as error:
            raise ConfigError(f"{self.world.model}: {' '.join(str(error).split())}") from error
        warned = {name: int(count) for name, count in zip(_WARNINGS, self.data.warning.number, strict=False) if count}
        if warned or not np.isfinite(self.data.qacc).all():
            raise ConfigError(
                f"{self.world.model}: cannot be simulated from its initial state: {warned or 'no acceleration'}"
            )
        package.mj_step1(self.model, self.data)
        self._last[0][:], self._last[1][:] = self.data.xpos, self.data.xquat


_WARNINGS: Final = ("inertia", "contacts full", "constraints full", "bad qpos", "bad qvel", "bad qacc", "bad ctrl")


def compile_bodies(scene: schema.Scene, before: kernels.Scene | None = None) -> RigidBodies | None:
    """Return the world of a scene, None without one; reuse the one of a scene `before`, if given.

    Raises ConfigError if the world differs from the one of `before`.
    """
    if scene.world is None:
        return None
    if before is None or before.bodies is None:
        return RigidBodies(scene.world)
    owner: RigidBodies = before.bodies.block.owner
    for key in ("model", "mass_kg", "substeps", "budget_us", "timestep", "keyframe"):
        now, new = getattr(owner.world, key), getattr(scene.world, key)
        if now != new:
            raise ConfigError(
                f"world.{key} cannot change while the scene runs (now {now!r}, given {new!r}): load the scene again"
            )
    return owner


def count_motion_values(scene: kernels.Scene) -> int:
    """Return the size of the array that describes the motion of a scene's bodies: `query.bodies.write_motion`."""
    moving = 0 if scene.bodies is None else len(scene.bodies.block.owner.moving)
    return 1 + at.MOTION_SIZE * moving


def decode_motion(names: list[str], values: NDArray[np.float64]) -> list[dict[str, Any]]:
    """Return the bodies of a message, from the array that `query.bodies.write_motion` writes."""
    return [
        {"name": name, "position": row[:3], "orientation": row[3:7], "velocity": row[7:10], "rate": row[10:13]}
        for name, row in zip(names, values[1:].reshape(-1, at.MOTION_SIZE).tolist(), strict=True)
    ]


def begin_bodies(scene: kernels.Scene, period_s: float) -> None:
    """Reset the bodies of a scene, if any, to the poses in the model, for ticks of `period_s`.

    See `RigidBodies.begin`.
    """
    if scene.bodies is not None:
        scene.bodies.block.owner.begin(period_s)


def check_bodies(scene: kernels.Scene) -> None:
    """Raise SafetyStop if the bodies of a scene have failed since their start."""
    if scene.bodies is not None and (failure := scene.bodies.block.owner.failure) is not None:
        raise failure
