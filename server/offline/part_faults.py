"""Faults of the parts of a scene or rig: files of its objects, its devices, recordings and keys; for `check`.

The parts of a faulty scene or rig that are usable by themselves are checked too.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial
from typing import Any, Final

from softfinger.config.errors import ConfigError, HapticError, RecordingError
from softfinger.config.fields import is_complete, is_usable
from softfinger.config.load import attempt
from softfinger.config.schema import DeviceConfig, Mesh, Rig, Scene, Servo
from softfinger.server.offline.summary import make_object_rows

PLAYERS: Final = ("replay", "simulated")
"""Drivers with an option `recording`, which they read when the device is opened."""


def check_parts(config: Any, file: str) -> list[str]:
    """Return the faults of the parts of a scene or rig; `file` is its name in messages."""
    checks = _iter_scene_checks(config) if isinstance(config, Scene) else _iter_rig_checks(config, file)
    faults = list[str]()
    for check in checks:
        attempt(check, faults)
    return faults


def _iter_scene_checks(scene: Scene) -> Iterator[Callable[[], object]]:
    for item in scene.object if is_usable(scene.object) else ():
        if (
            is_complete(item)
            and is_usable(item.shape)
            and not _has_complaint(item, "file")
            and not (isinstance(item, Mesh) and item.elastic is not None and any(item.elastic.faults()))
        ):
            yield partial(make_object_rows, item, has_patch=False)
    if scene.world is not None and is_complete(scene.world) and not _has_complaint(scene.world, "model"):
        from softfinger.config.mjcf import read_model

        yield partial(read_model, scene.world)


def _iter_rig_checks(rig: Any, file: str) -> Iterator[Callable[[], object]]:
    if not isinstance(rig, Rig):
        return
    if rig.security is not None and is_complete(rig.security):
        from softfinger.server.socket_process.allowed import list_key_folders

        yield partial(list_key_folders, rig.security)
    rate_hz = rig.servo.rate_hz if is_complete(rig.servo) else Servo().rate_hz
    tables = rig.tables if is_usable(rig.device, rig.devices) else {}
    for table, device in tables.items():
        if is_complete(device):
            yield partial(_check_device, device, rate_hz, table, file)


def _has_complaint(table: Any, key: str) -> bool:
    """Return True if the check of a table itself reports a key."""
    return any(name == key for name, *_ in table.faults())


def _check_device(device: DeviceConfig, rate_hz: float, table: str, file: str) -> None:
    """Raise ConfigError for an unknown driver, options or a rate that it refuses, or an unusable recording."""
    from softfinger.drivers import registry

    try:
        registry.load(device.driver)
    except HapticError as error:
        raise ConfigError(f"{file}: {table}.driver = {device.driver!r}: {error}") from error
    registry.check(device, rate_hz, f"{file} [{table}]")
    recording = device.options.get("recording")
    if device.driver not in PLAYERS or recording is None:
        return
    from softfinger.drivers.poses import load_poses

    try:
        load_poses(recording)
    except RecordingError as error:
        raise ConfigError(f"{file}: {table}.recording: {error}") from error
