"""The rigid bodies of a scene's [world]: MuJoCo's model and data, and their addresses for the kernels.

MuJoCo does not document `_address` of its objects, which this file alone uses; tests/proxy/test_bodies.py checks it.
"""

from __future__ import annotations

import ctypes
from pathlib import Path
from typing import Any, Final

import numpy as np

from softfinger.config import schema
from softfinger.config.errors import ConfigError, SafetyStop
from softfinger.config.mjcf import moves, mujoco_module, read_model
from softfinger.config.urdf import is_urdf
from softfinger.proxy.kernels import model as kernels
from softfinger.proxy.kernels.jit.arrays import ReadOnly
from softfinger.proxy.kernels.jit.decorators import PLAIN
from softfinger.proxy.kernels.jit.rescue import RESCUE_ALIGNMENT, RESCUE_BYTES, jump_on_error, words_in
from softfinger.proxy.kernels.query import bodies as at

TIMESTEP_TOLERANCE: Final = 1e-6
"""Relative: a period of whole nanoseconds is the timestep that a model has in decimal seconds."""
URDF_TIMESTEP_S: Final = 0.002
"""MuJoCo's default time step. A URDF cannot give one: it takes the servo's."""


class _LogConfig(ctypes.Structure):
    """mjLogConfig of mjtype.h; all zero: MuJoCo writes neither to the terminal nor to MUJOCO_LOG.TXT."""

    _fields_ = (
        ("logto_console", ctypes.c_uint8),
        ("logto_file", ctypes.c_uint8),
        ("logfile", ctypes.c_char * 1024),
        ("topics", ctypes.c_int),
    )


class Block(ReadOnly):
    """Addresses of a simulation, whose memory lives as long as this does."""

    __slots__ = ("owner",)

    def __init__(self, words: Any, owner: RigidBodies) -> None:
        super().__init__(words)
        self.owner: Final = owner


class RigidBodies:
    """A world: MuJoCo's `model` and `data`. Raises ConfigError for a model that cannot be simulated."""

    def __init__(self, world: schema.World) -> None:
        self.world: Final = world
        package = mujoco_module()
        _, self.model = read_model(world.model)
        # What diverges is to be seen, and not to be put back where it began without a word.
        self.model.opt.disableflags |= package.mjtDisableBit.mjDSBL_AUTORESET
        self._without_timestep: Final = is_urdf(world.model) and self.model.opt.timestep == URDF_TIMESTEP_S
        self.data: Final = package.MjData(self.model)
        self.moving: Final = [body for body in range(1, self.model.nbody) if moves(self.model, body)]
        """Numbers of the bodies that can move, and their names, or numbers where they have none."""
        self.names: Final = [self.model.body(body).name or str(body) for body in self.moving]
        self._library: Final = _library(package)
        self._library.mju_setLogConfig(_LogConfig())  # warnings are counted: a servo thread writes no file
        if not PLAIN:  # Python's own calls of MuJoCo raise as before
            self._library.mju_setLogHandler.argtypes = (ctypes.c_void_p,)
            self._library.mju_setLogHandler(jump_on_error.address)
        self._fault: Final = np.zeros(2, np.int64)
        self._last: Final = (np.zeros_like(self.data.xpos), np.zeros_like(self.data.xquat))
        self._memory: Final = np.zeros(RESCUE_BYTES + RESCUE_ALIGNMENT, np.uint8)
        self._rescue: Final = -(-self._memory.ctypes.data // RESCUE_ALIGNMENT) * RESCUE_ALIGNMENT
        self._said = ""
        self.block: Final = Block(self._words(self._library), self)

    def _words(self, library: ctypes.CDLL) -> Any:
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
        """A half of a step by MuJoCo's own package, for kernels that are plain Python: whether it met an error."""
        package = mujoco_module()
        try:
            (package.mj_step1 if half == at.FIRST_HALF else package.mj_step2)(self.model, self.data)
        except package.FatalError as error:
            self._said = " ".join(str(error).split())
            return True
        return False

    @property
    def failure(self) -> SafetyStop | None:
        """Why the bodies stand still, in MuJoCo's words and with what to do; None while they move."""
        fault = int(self._fault[0])
        if fault == at.NO_FAULT:
            return None
        what = f"[world] {self.world.model}: the bodies were let go and stand still"
        if fault == at.SLOW:
            return SafetyStop(
                f"{what}: most steps took longer than world.budget_us = {self.world.budget_us:g}; take fewer bodies or "
                "simpler geoms, raise the budget, or lower servo.rate_hz"
            )
        remedy = (
            "lower stiffness_n_per_m, or raise damping_ns_per_m or world.substeps; where memory is full, give the "
            'model <size memory="..."/>'
        )
        if fault == at.WARNED:
            counted = self.data.warning
            kind = int(np.flatnonzero(counted.number)[0])
            said = mujoco_module().mju_warningText(kind, counted.lastinfo[kind]).rstrip(". ")
        else:
            said = self._said or words_in(self._rescue)
        return SafetyStop(f"{what}: MuJoCo said: {said}: {remedy}")

    def kernel(self, riders: tuple[float, ...]) -> kernels.Bodies:
        """What kernels take; `riders` as of Bodies."""
        return kernels.Bodies(
            self.block, ReadOnly(np.array(self.moving, np.int64)), ReadOnly(np.array(riders)), float(len(riders))
        )

    def number_of(self, body: str) -> int:
        """Number of a body by its name, or by its number where it has no name; ConfigError for none of the model."""
        package = mujoco_module()
        number = package.mj_name2id(self.model, package.mjtObj.mjOBJ_BODY, body)
        if number < 0 and body.isdecimal() and int(body) < self.model.nbody:
            number = int(body)
        if number < 0:
            names = [self.model.body(each).name or str(each) for each in range(1, self.model.nbody)]
            raise ConfigError(f"motion.body = {body!r} is no body of {self.world.model}; it has {', '.join(names)}")
        return int(number)

    def begin(self, period_s: float) -> None:
        """Put everything where the model has it, for ticks of `period_s`.

        ConfigError where the model's time step is another, or where its beginning has no finite acceleration.
        """
        package = mujoco_module()
        if self._without_timestep:
            self.model.opt.timestep = period_s / self.world.substeps
        step = self.model.opt.timestep * self.world.substeps
        if abs(step - period_s) > TIMESTEP_TOLERANCE * period_s:
            raise ConfigError(
                f"{self.world.model}: its timestep of {self.model.opt.timestep:g} s, world.substeps = "
                f"{self.world.substeps} times, is not a tick of {period_s:g} s: write "
                f'<option timestep="{period_s / self.world.substeps:g}"/>, or take another rate'
            )
        self._fault[:] = 0
        self._said = ""
        try:
            package.mj_resetData(self.model, self.data)
            package.mj_forward(self.model, self.data)
        except package.FatalError as error:
            raise ConfigError(f"{self.world.model}: {' '.join(str(error).split())}") from error
        warned = {name: int(count) for name, count in zip(_WARNINGS, self.data.warning.number, strict=False) if count}
        if warned or not np.isfinite(self.data.qacc).all():
            raise ConfigError(f"{self.world.model}: cannot be simulated as it begins: {warned or 'no acceleration'}")
        package.mj_step1(self.model, self.data)
        self._last[0][:], self._last[1][:] = self.data.xpos, self.data.xquat


_WARNINGS: Final = ("inertia", "contacts full", "constraints full", "bad qpos", "bad qvel", "bad qacc", "bad ctrl")


def bodies_of(scene: schema.Scene, before: kernels.Scene | None = None) -> RigidBodies | None:
    """The world of a scene, None for one without; that of a scene `before` goes on, and has to be the same."""
    if scene.world is None:
        return None
    if before is None or before.bodies is None:
        return RigidBodies(scene.world)
    owner: RigidBodies = before.bodies.block.owner
    for key in ("model", "substeps", "budget_us"):
        now, given = getattr(owner.world, key), getattr(scene.world, key)
        if now != given:
            raise ConfigError(
                f"world.{key} cannot change while the scene runs (now {now!r}, given {given!r}): load it anew"
            )
    return owner


def motion_size(scene: kernels.Scene) -> int:
    """Numbers that tell of the motion of a scene's bodies: `query.bodies.tell_motion`."""
    moving = 0 if scene.bodies is None else len(scene.bodies.block.owner.moving)
    return 1 + at.MOTION_SIZE * moving


def begin_bodies(scene: kernels.Scene, period_s: float) -> None:
    """Put the bodies of a scene, if it has any, where its model has them, for ticks of `period_s`; see
    `RigidBodies.begin`."""
    if scene.bodies is not None:
        scene.bodies.block.owner.begin(period_s)


def check_bodies(scene: kernels.Scene) -> None:
    """Raise SafetyStop if the bodies of a scene, if it has any, have failed since they began."""
    if scene.bodies is not None and (failure := scene.bodies.block.owner.failure) is not None:
        raise failure


def _library(package: Any) -> ctypes.CDLL:
    folder = Path(package.__file__).parent
    found = sorted(folder.glob("libmujoco.so*")) + sorted(folder.glob("libmujoco*.dylib"))
    if not found:
        raise ConfigError(f"[world]: {folder} has no libmujoco: reinstall the package mujoco-core")
    return ctypes.CDLL(str(found[0]))
