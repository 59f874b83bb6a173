"""Conversion of the configuration (scene, guard, tools) into the parameters of a tick."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from math import inf
from typing import Any, Final

import numba

from softfinger.config import schema
from softfinger.drivers.base import DeviceInfo
from softfinger.proxy.kernels.jit.compiler.progress import COMPILE_PROGRESS
from softfinger.proxy.kernels.jit.rows import Rows
from softfinger.proxy.kernels.model import Vec3
from softfinger.proxy.kernels.numerics.tool import make_tool
from softfinger.proxy.scene import build_scene
from softfinger.server.loop.guard import Guard
from softfinger.server.loop.hand_limits import NO_WALL, SLOW_TIME_S, Limits, Workspace
from softfinger.server.loop.passivity import Passivity
from softfinger.server.loop.tick import UNMOVED, Tuning

log: Final = logging.getLogger(__name__)

DAMPING_MAX_NS_PER_M: Final = 20.0
"""Default of the passivity controller's largest damping: at 1 kHz it is stable for devices down to 20 g."""

KERNELS: Final = {"": 240, "heightmap": 70, "mesh": 200, "several": 90, "world": 80}
"""Estimated kernels that the loop of a scene compiles with an empty cache, and those that parts of a scene add: rounded
up for `paper-plane` (229), `heightmap` (299), `bend-a-strip` (432), `ball-in-a-bowl` (393) and `lift-a-box` (396)."""

FORCE_DOF: Final = 3
"""Degrees of freedom of a device that displays only forces."""


def make_tuning(
    scene: schema.Scene,
    guard: schema.Guard,
    devices: Sequence[DeviceInfo] = (),
    tools: Sequence[schema.Tool | None] = (),
) -> Tuning:
    """Return the parameters of the servo for a scene, a guard and each finger's tool, within the limits of its device.

    Logs a warning for each object stiffer than the specified maximum of a device, which is rendered anyway, and for
    geoms of a model that fingers pass through.
    """
    _warn_of_lost_geoms(scene)
    guards = tuple(make_guard(guard, info) for info in devices)
    for info, limits in zip(devices, guards, strict=True):
        if limits.force_max > 0.0:
            _warn_if_too_stiff(scene, limits.force_max, info)
    guards = guards or (make_guard(guard),) * len(scene.fingers)
    made_tools = tuple(None if tool is None else make_tool(tool.offset_m, tool.orientation_wxyz) for tool in tools)
    made_tools = made_tools or (None,) * len(scene.fingers)
    COMPILE_PROGRESS.expect(estimate_kernels(scene))
    return Tuning(
        build_scene(scene), guards, _make_passivity(scene.passivity), made_tools, (UNMOVED,) * len(scene.fingers)
    )


def estimate_kernels(scene: schema.Scene) -> int:
    """Return about how many kernels the loop of a scene compiles with an empty cache, for a progress message."""
    has = {
        "": True,
        "heightmap": any(isinstance(obj, schema.Heightmap) for obj in scene.object),
        "mesh": any(isinstance(obj, schema.Mesh) for obj in scene.object),
        "several": len(scene.object) + len(scene.fingers) > 2,
        "world": scene.world is not None,
    }
    return sum(count for name, count in KERNELS.items() if has[name])


def with_scene(tuning: Tuning, scene: schema.Scene) -> Tuning:
    return tuning._replace(scene=build_scene(scene, tuning.scene), passivity=_make_passivity(scene.passivity))


def _warn_of_lost_geoms(scene: schema.Scene) -> None:
    if scene.world is None:
        return
    from softfinger.config.mjcf_geoms import find_ignored  # it needs MuJoCo

    for geom in find_ignored(scene):
        log.warning("fingers pass through geom '%s': it %s", geom.name, geom.note)


def _warn_if_too_stiff(scene: schema.Scene, force_max: float, device: DeviceInfo) -> None:
    for obj in scene.object:
        stiffness = obj.material.stiffness_under(force_max)
        if stiffness > device.stiffness_max_n_per_m * (1.0 + 1e-9):  # beyond rounding
            log.warning(
                "object '%s' has %.0f N/m at the guard's %g N, above the %g N/m of device %s, and may vibrate: lower "
                "stiffness_n_per_m%s",
                obj.name,
                stiffness,
                force_max,
                device.stiffness_max_n_per_m,
                device.name,
                "" if obj.material.normal is None else " or guard.force_max_n",
            )


def make_guard(guard: schema.Guard, device: DeviceInfo | None = None) -> Guard:
    """Return the guard of a rig, armed, and lowered to the limits of the device.

    Poses are checked only if the device holds a force in a hand: recorded or computed poses may jump and repeat.
    """
    force, torque = guard.force_max_n, guard.torque_max_nm
    if device is not None and force > device.force_max_n:
        log.warning("guard.force_max_n = %g N is reduced to the %g N of the device", force, device.force_max_n)
        force = device.force_max_n
    if device is not None and torque > device.torque_max_nm:
        log.warning("guard.torque_max_nm = %g N m is reduced to the %g N m of the device", torque, device.torque_max_nm)
        torque = device.torque_max_nm
    limits = Guard(force, torque, guard.force_slew_n_per_s, guard.torque_slew_nm_per_s, guard.ramp_s, 1.0)
    if device is not None and device.actuated_dof <= FORCE_DOF:
        limits = limits._replace(displays_torque=0.0)
    if device is None or not device.has_persistent_force:
        return limits
    pose_checks = {"speed_max": guard.speed_max_m_per_s, "turn_max": guard.turn_max_rad_per_s, "frozen": guard.frozen_s}
    return limits._replace(**pose_checks, limits=make_hand_limits(guard))


def make_hand_limits(guard: schema.Guard) -> Limits:
    """Return the limits that protect a hand: its speed, the heat of the motors, the energy given, and the workspace."""
    slow_s = SLOW_TIME_S if guard.arm == "automatic" else inf
    continuous = inf if guard.continuous_force_n is None else guard.continuous_force_n
    speed, wall = guard.handle_speed_max_m_per_s, _make_wall(guard.workspace)
    return Limits(speed, slow_s, continuous, guard.heat_time_s, guard.energy_max_j, wall)


def _make_wall(workspace: schema.Workspace | None) -> Workspace:
    if workspace is None:
        return NO_WALL
    x, y, z = (0.0, 0.0, 0.0) if workspace.size_m is None else workspace.size_m
    half, radius = (0.5 * x, 0.5 * y, 0.5 * z), 0.0 if workspace.radius_m is None else workspace.radius_m
    return Workspace(workspace.center_m, half, radius, workspace.stiffness_n_per_m, workspace.force_max_n)


def with_offsets(tuning: Tuning, offsets: tuple[Vec3, ...]) -> Tuning:
    """Return the tuning with other offsets of the devices' positions; the workspace of each moves with its offset."""
    guards = []
    for guard, before, after in zip(tuning.guards, tuning.offsets, offsets, strict=True):
        wall = guard.limits.workspace
        center = tuple(x + (b + 0.0) - (a + 0.0) for x, a, b in zip(wall.center, before, after, strict=True))
        guards.append(guard._replace(limits=guard.limits._replace(workspace=wall._replace(center=center))))
    return tuning._replace(offsets=offsets, guards=tuple(guards))


def _make_passivity(passivity: schema.Passivity | None) -> Passivity | None:
    if passivity is None:
        return None
    if passivity.mode == "observe":
        return Passivity(0.0)
    damping_max = passivity.damping_max_ns_per_m
    return Passivity(DAMPING_MAX_NS_PER_M if damping_max is None else damping_max)


def with_armed(tuning: Tuning, share: float) -> Tuning:
    """Return the tuning with its guards armed (1) or disarmed (0): the share of the force passed after the ramp."""
    return tuning._replace(guards=tuple(guard._replace(armed=share) for guard in tuning.guards))


def has_same_structure(a: Any, b: Any) -> bool:
    """Return whether two trees have the same structure, so that one compiled loop serves both.

    Calling `numba.typeof` on the trees would take milliseconds.
    """
    if isinstance(a, tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(has_same_structure, a, b))
    if isinstance(a, float):
        return isinstance(b, float)
    if isinstance(a, Rows) and (not isinstance(b, Rows) or len(a) != len(b)):
        return False
    return b is None if a is None else bool(numba.typeof(a) == numba.typeof(b))
