"""Devices of a scene's fingers: opening them, and the check whether another scene or rig can use them."""

from __future__ import annotations

from softfinger.config import schema
from softfinger.config.errors import ConfigError
from softfinger.config.schema.pairing import pair_devices
from softfinger.drivers import registry
from softfinger.drivers.base import Device
from softfinger.server.loop import shutdown


def open_finger_devices(scene: schema.Scene, rig: schema.Rig) -> tuple[Device, ...]:
    """Open the device of each finger; on an error, close the devices opened before."""
    devices = list[Device]()
    with shutdown.close_on_error(devices):
        for finger in pair_devices(scene, rig):
            devices.append(registry.open_device(finger.device, rig.servo.rate_hz, finger.table))
    return tuple(devices)


def inject_faults(
    devices: tuple[Device, ...], scene: schema.Scene, faults: schema.Faults | None, rate_hz: float
) -> tuple[Device, ...]:
    """Return the devices with faults injected, if any; raises ConfigError for a fault of a finger that is missing."""
    if faults is None:
        return devices
    names = [finger.name for finger in scene.fingers]
    for fault in faults.fault:
        if fault.finger not in ("", *names):
            raise ConfigError(
                f"a fault of kind '{fault.kind}' has finger = '{fault.finger}': the scene has "
                f"{', '.join(repr(name) for name in names if name) or 'a single one, without a name'}: remove finger"
            )
    from softfinger.drivers.fault_injector import (
        FaultInjector,
    )  # imported here, because its kernels are compiled on import

    return tuple(FaultInjector(device, faults, rate_hz, name) for device, name in zip(devices, names, strict=True))


def make_tools(scene: schema.Scene, rig: schema.Rig) -> list[schema.Tool | None]:
    return [finger.device.tool for finger in pair_devices(scene, rig)]


def check_replacement(
    scene: schema.Scene, rig: schema.Rig, running_scene: schema.Scene, running_rig: schema.Rig
) -> None:
    """Raise ConfigError if a scene and a rig cannot replace the running ones, as far as known without compiling."""
    for finger_device in pair_devices(scene, rig):
        registry.read_options(finger_device.device, finger_device.table)
    new_names, old_names = ([finger.name for finger in described.fingers] for described in (scene, running_scene))
    if new_names != old_names and max(len(new_names), len(old_names)) > 1:
        raise ConfigError(
            f"the fingers of the new scene ({', '.join(new_names)}) differ from the running ones "
            f"({', '.join(old_names)}), and the names in telemetry cannot change: start another daemon"
        )
    for name, new, old in (
        ("[telemetry]", rig.telemetry, running_rig.telemetry),
        ("[commands]", rig.commands, running_rig.commands),
        ("[recording]", rig.recording, running_rig.recording),
        ("[security]", rig.security, running_rig.security),
        ("[metrics]", rig.metrics, running_rig.metrics),
        ("servo.realtime", rig.servo.realtime, running_rig.servo.realtime),
        ("servo.priority", rig.servo.priority, running_rig.servo.priority),
        ("servo.cpu", rig.servo.cpu, running_rig.servo.cpu),
    ):
        if new != old:
            raise ConfigError(
                f"{name} = {new} of the new rig differs from {old}, which cannot change in a running "
                "daemon: use the old value, or start another daemon"
            )
