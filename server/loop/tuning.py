"""From configuration to the parameters of a tick."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from math import inf
from pathlib import Path
from typing import Any, Final

import numba

from softfinger.config import schema
from softfinger.drivers.base import DeviceInfo
from softfinger.proxy.kernels import model
from softfinger.proxy.kernels.jit.rows import Rows
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics.tool import make_tool
from softfinger.proxy.scene import build_scene
from softfinger.server.loop.guard import Guard
from softfinger.server.loop.limits import NO_WALL, SLOW_S, Limits, Workspace
from softfinger.server.loop.passivity import Passivity
from softfinger.server.loop.tick import UNMOVED, Tuning
from softfinger.server.progress import progress

log: Final = logging.getLogger(__name__)

DAMPING_MAX_NS_PER_M: Final = 20.0
"""Of the passivity controller, where the scene gives none: at 1 kHz a device of 20 g still bears it."""

FORCE_DOF: Final = 3
"""Degrees of freedom that a device which displays forces alone is moved in."""


def make_tuning(
    scene: schema.Scene,
    guard: schema.Guard,
    devices: Sequence[DeviceInfo] = (),
    tools: Sequence[schema.Tool | None] = (),
) -> Tuning:
    """Parameters of the servo for a scene, a guard and each finger's tool; what its device allows is never exceeded.

    Of an object that is stiffer than a device is said to hold a warning tells; it is rendered all the same.
    """
    guards = tuple(guard_limits(guard, info) for info in devices)
    for info, limits in zip(devices, guards, strict=True):
        if limits.force_max > 0.0:
            _tell_what_is_too_stiff(scene, limits.force_max, info)
    guards = guards or (guard_limits(guard),) * len(scene.fingers)
    held = tuple(None if tool is None else make_tool(tool.offset_m, tool.orientation_wxyz) for tool in tools)
    held = held or (None,) * len(scene.fingers)
    return Tuning(_built(scene), guards, _passivity(scene.passivity), held, (UNMOVED,) * len(scene.fingers))


def _built(scene: schema.Scene) -> model.Scene:
    """The scene as it is rendered; what its meshes need may take seconds the first time, and shows that it goes on."""
    files = [Path(thing.file).name for thing in scene.object if isinstance(thing, schema.Mesh)]
    if not files:
        return build_scene(scene)
    with progress(f"reading {', '.join(files)}"):
        return build_scene(scene)


def with_scene(tuning: Tuning, scene: schema.Scene) -> Tuning:
    """The tuning with other parameters of its scene, and the same guard."""
    return tuning._replace(scene=build_scene(scene, tuning.scene), passivity=_passivity(scene.passivity))


def _tell_what_is_too_stiff(scene: schema.Scene, force_max: float, device: DeviceInfo) -> None:
    for thing in scene.object:
        stiffness = thing.material.stiffness_under(force_max)
        if stiffness > device.stiffness_max_n_per_m * (1.0 + 1e-9):  # more than rounding
            log.warning(
                "object '%s' has %.0f N/m at the guard's %g N, beyond the %g N/m of device %s, and may buzz: lower "
                "stiffness_n_per_m%s",
                thing.name,
                stiffness,
                force_max,
                device.stiffness_max_n_per_m,
                device.name,
                "" if thing.material.normal is None else " or guard.force_max_n",
            )


def guard_limits(guard: schema.Guard, device: DeviceInfo | None = None) -> Guard:
    """The guard of a rig, armed, lowered to what the device allows.

    Poses are doubted where a force is held in a hand: what is recorded or computed may jump and stand still.
    """
    force, torque = guard.force_max_n, guard.torque_max_nm
    if device is not None and force > device.force_max_n:
        log.warning("guard.force_max_n = %g N is lowered to the device's %g N", force, device.force_max_n)
        force = device.force_max_n
    if device is not None and torque > device.torque_max_nm:
        log.warning("guard.torque_max_nm = %g N m is lowered to the device's %g N m", torque, device.torque_max_nm)
        torque = device.torque_max_nm
    limits = Guard(force, torque, guard.force_slew_n_per_s, guard.torque_slew_nm_per_s, guard.ramp_s, 1.0)
    if device is not None and device.actuated_dof <= FORCE_DOF:
        limits = limits._replace(turns=0.0)
    if device is None or not device.holds_a_force:
        return limits
    doubting = {"speed_max": guard.speed_max_m_per_s, "turn_max": guard.turn_max_rad_per_s, "frozen": guard.frozen_s}
    return limits._replace(**doubting, limits=hand_limits(guard))


def hand_limits(guard: schema.Guard) -> Limits:
    """The limits for a hand that a device may harm: its speed, the motors' heat, energy given, the workspace."""
    slow_s = SLOW_S if guard.arm == "automatic" else inf
    continuous = inf if guard.continuous_force_n is None else guard.continuous_force_n
    speed, wall = guard.handle_speed_max_m_per_s, _wall(guard.workspace)
    return Limits(speed, slow_s, continuous, guard.heat_time_s, guard.energy_max_j, wall)


def _wall(asked: schema.Workspace | None) -> Workspace:
    if asked is None:
        return NO_WALL
    x, y, z = (0.0, 0.0, 0.0) if asked.size_m is None else asked.size_m
    half, radius = (0.5 * x, 0.5 * y, 0.5 * z), 0.0 if asked.radius_m is None else asked.radius_m
    return Workspace(asked.center_m, half, radius, asked.stiffness_n_per_m, asked.force_max_n)


def with_offsets(tuning: Tuning, offsets: tuple[Vec3, ...]) -> Tuning:
    """The tuning with other offsets of the positions that devices say; the workspace of each goes along."""
    guards = []
    for guard, before, after in zip(tuning.guards, tuning.offsets, offsets, strict=True):
        wall = guard.limits.workspace
        center = tuple(x + (b + 0.0) - (a + 0.0) for x, a, b in zip(wall.center, before, after, strict=True))
        guards.append(guard._replace(limits=guard.limits._replace(workspace=wall._replace(center=center))))
    return tuning._replace(offsets=offsets, guards=tuple(guards))


def _passivity(wanted: schema.Passivity | None) -> Passivity | None:
    if wanted is None:
        return None
    if wanted.mode == "observe":
        return Passivity(0.0)
    given = wanted.damping_max_ns_per_m
    return Passivity(DAMPING_MAX_NS_PER_M if given is None else given)


def with_armed(tuning: Tuning, share: float) -> Tuning:
    """The tuning whose guards let this share of the force through once their ramp is over: 1, or 0 for none."""
    return tuning._replace(guards=tuple(guard._replace(armed=share) for guard in tuning.guards))


def fading_out(tuning: Tuning) -> Tuning:
    """The tuning with which each guard brings its force to zero along its slew limit."""
    return tuning._replace(guards=tuple(guard._replace(force_max=0.0, torque_max=0.0) for guard in tuning.guards))


def seconds_to_zero(tuning: Tuning) -> float:
    """How long, s, the guards' slew limits take to bring the largest force and torque to zero."""
    guards: tuple[Guard, ...] = tuning.guards
    return max(max(guard.force_max / guard.force_slew, guard.torque_max / guard.torque_slew) for guard in guards)


def alike(a: Any, b: Any) -> bool:
    """Whether two trees have the same parts, so that one loop serves both; `numba.typeof` takes milliseconds for it."""
    if isinstance(a, tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(alike, a, b))
    if isinstance(a, float):
        return isinstance(b, float)
    if isinstance(a, Rows) and (not isinstance(b, Rows) or len(a) != len(b)):
        return False
    return b is None if a is None else bool(numba.typeof(a) == numba.typeof(b))
