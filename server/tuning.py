"""From configuration to the parameters of a tick."""

from __future__ import annotations

import logging
from typing import Final

from softfinger.config import schema
from softfinger.drivers.base import DeviceInfo
from softfinger.proxy.scene import build_scene
from softfinger.server.guard import Guard
from softfinger.server.passivity import Passivity
from softfinger.server.tick import Tuning

log: Final = logging.getLogger(__name__)

DAMPING_MAX_NS_PER_M: Final = 20.0
"""Of the passivity controller, where the scene gives none: at 1 kHz a device of 20 g still bears it."""


def make_tuning(scene: schema.Scene, guard: schema.Guard, device: DeviceInfo | None = None) -> Tuning:
    """Parameters of the servo for a scene and a guard; what the device allows is never exceeded."""
    return Tuning(build_scene(scene), guard_limits(guard, device), _passivity(scene.passivity))


def guard_limits(guard: schema.Guard, device: DeviceInfo | None = None) -> Guard:
    """The guard of a rig, armed, lowered to what the device allows."""
    force, torque = guard.force_max_n, guard.torque_max_nm
    if device is not None and force > device.force_max_n:
        log.warning("guard.force_max_n = %g N is lowered to the device's %g N", force, device.force_max_n)
        force = device.force_max_n
    if device is not None and torque > device.torque_max_nm:
        log.warning("guard.torque_max_nm = %g N m is lowered to the device's %g N m", torque, device.torque_max_nm)
        torque = device.torque_max_nm
    return Guard(force, torque, guard.force_slew_n_per_s, guard.torque_slew_nm_per_s, guard.ramp_s, 1.0)


def _passivity(wanted: schema.Passivity | None) -> Passivity | None:
    if wanted is None:
        return None
    if wanted.mode == "observe":
        return Passivity(0.0)
    given = wanted.damping_max_ns_per_m
    return Passivity(DAMPING_MAX_NS_PER_M if given is None else given)
