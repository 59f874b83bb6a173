"""Faults of the parts of a scene or rig: files of its objects, its devices, recordings and keys; for `check`.

The parts of a faulty scene or rig that are usable by themselves are checked too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import Any

import msgspec

from softfinger.config.errors import ConfigError, HapticError, RecordingError
from softfinger.config.fields import known
from softfinger.config.load import FaultyConfig
from softfinger.config.schema import DeviceConfig, Object, Rig, Scene, Servo, World
from softfinger.server.offline.summary import object_rows


def part_faults(config: Any, file: str) -> list[str]:
    """Return the faults of the parts of a scene or rig; `file` is its name in messages."""
    checks = _scene_checks(config) if isinstance(config, Scene) else _rig_checks(config, file)
    return [fault for check in checks for fault in _faults(check)]


def _faults(check: Callable[[], object]) -> list[str]:
    try:
        check()
    except FaultyConfig as error:
        return [str(fault) for fault in error.faults]
    except HapticError as error:
        return [str(error)]
    return []


def _scene_checks(scene: Scene) -> Iterator[Callable[[], object]]:
    for item in scene.object if known(scene.object) else ():
        if _is_complete(item) and known(item.shape):
            yield partial(_check_object, item)
    if scene.world is not None and _is_complete(scene.world):
        yield partial(_check_world, scene.world)


def _rig_checks(rig: Any, file: str) -> Iterator[Callable[[], object]]:
    if not isinstance(rig, Rig):
        return
    if rig.security is not None and _is_complete(rig.security):
        from softfinger.server.publishing.allowed import key_folders

        yield partial(key_folders, rig.security)
    rate_hz = rig.servo.rate_hz if _is_complete(rig.servo) else Servo().rate_hz
    tables = rig.tables if known(rig.device, rig.devices) else {}
    for table, device in tables.items():
        if _is_complete(device):
            yield partial(_check_device, device, rate_hz, table, file)


def _is_complete(value: object) -> bool:
    """Return True if a value has no unusable part."""
    if isinstance(value, msgspec.Struct):
        return all(_is_complete(getattr(value, name)) for name in value.__struct_fields__)
    if isinstance(value, Mapping):
        return all(map(_is_complete, value.values()))
    return all(map(_is_complete, value)) if isinstance(value, list | tuple) else known(value)


def _check_object(item: Object) -> None:
    """Raise ConfigError for an unusable file of an object."""
    object_rows(item, has_patch=False)


def _check_world(world: World) -> None:
    """Raise ConfigError for an unusable model."""
    from softfinger.config.mjcf import read_model

    read_model(world)


def _check_device(device: DeviceConfig, rate_hz: float, table: str, file: str) -> None:
    """Raise ConfigError for an unknown driver, options or a rate that it refuses, or an unusable recording."""
    from softfinger.drivers import registry

    try:
        registry.load(device.driver)
    except HapticError as error:
        raise ConfigError(f"{file}: {table}.driver = {device.driver!r}: {error}") from error
    registry.check(device, rate_hz, f"{file} [{table}]")
    if device.driver != "replay":
        return
    from softfinger.drivers.poses import load_poses

    try:
        load_poses(device.options["recording"])
    except RecordingError as error:
        raise ConfigError(f"{file}: {table}.recording: {error}") from error
