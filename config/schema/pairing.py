"""Assignment of the devices of a rig to the fingers of a scene."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from softfinger.config.errors import ConfigError
from softfinger.config.schema.rig import DeviceConfig, Rig
from softfinger.config.schema.scene import Scene


class FingerDevice(NamedTuple):
    """Finger, by name ("" for the only one of [fingertip]), and its device, by its table in the rig."""

    finger: str
    table: str
    device: DeviceConfig


def pair_devices(scene: Scene, rig: Rig) -> tuple[FingerDevice, ...]:
    """Return the device of each finger of the scene, in the order of the fingers.

    [device] moves the only finger of a scene. Otherwise each finger names its [devices.NAME]. Devices that no finger
    names are not opened. Raises ConfigError if a finger has no device.
    """
    fingers = scene.fingers
    if rig.device is not None and len(fingers) == 1:
        return (FingerDevice(fingers[0].name, "[device]", rig.device),)
    has = "[device]" if rig.device is not None else _join_tables(rig.devices)
    if scene.fingertip is not None:
        raise ConfigError(
            f"the scene has [fingertip], a single finger without a name, but the rig has {has}: use a rig with "
            "[device], or a table [[finger]] in the scene that names a section of the rig"
        )
    lacking = [finger.device for finger in fingers if finger.device not in rig.devices]
    if lacking:
        names = ", ".join(f"'{finger.name}'" for finger in fingers)
        raise ConfigError(
            f"the scene has [[finger]] {names}, but the rig has {has}: add {_join_tables(lacking)} to the rig, set "
            "device of the finger to an existing section, or use a scene with [fingertip]"
        )
    return tuple(
        FingerDevice(finger.name, f"[devices.{finger.device}]", rig.devices[finger.device]) for finger in fingers
    )


def find_single_device(rig: Rig) -> DeviceConfig:
    """Return the device of a rig with one device; raises ConfigError for a rig with a device for each finger."""
    if rig.device is None:
        raise ConfigError(
            f"the rig has {_join_tables(rig.devices)}, but this command needs a single device: use a rig with [device]"
        )
    return rig.device


def _join_tables(names: Iterable[str]) -> str:
    return " and ".join(f"[devices.{name}]" for name in names)
