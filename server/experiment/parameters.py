"""Parameters of an experiment that are no keys of the scene: `rig.guard.KEY` of the rig, and `mass.BODY`.

A running daemon changes both at zero force. `mass.BODY` is `world.mass_kg` of the scene.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from msgspec.structs import fields

from softfinger.config.errors import ConfigError
from softfinger.config.load import FaultyConfig, SceneSource, add_objects_of_world, apply_overrides, load_scene
from softfinger.config.schema import Guard, Rig, Scene

if TYPE_CHECKING:  # experiment files are read without importing drivers
    from softfinger.drivers.base import DeviceInfo

RIG_PREFIX: Final = "rig."
MASS_PREFIX: Final = "mass."
FIXED_KEYS: Final = frozenset({"arm", "workspace"})
"""Keys of the guard that cannot be parameters: the right to arm is not a stimulus, and a workspace is compiled."""
CHANGEABLE_KEYS: Final = frozenset(
    f"{RIG_PREFIX}guard.{field.name}" for field in fields(Guard) if field.name not in FIXED_KEYS
)
"""Parameters that can change between two touches; the devices remain open."""
_TABLES: Final = {field.name for field in fields(Rig)} - {field.name for field in fields(Scene)}


def split_rig(values: Mapping[str, Any], where: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the values of the rig by dotted key, and the parameters of the scene.

    Raises ConfigError if a value of the rig needs a restart of the daemon.
    """
    faults = [
        f"{where}: {path}: cannot change in a running daemon, so it cannot be a factor: run a session with "
        f"--rig for each of its levels; of the rig there are {', '.join(sorted(CHANGEABLE_KEYS))}"
        for path in values
        if (path.startswith(RIG_PREFIX) or path.partition(".")[0] in _TABLES) and path not in CHANGEABLE_KEYS
    ]
    if faults:
        raise FaultyConfig(faults)
    rig_values = {path.removeprefix(RIG_PREFIX): value for path, value in values.items() if path in CHANGEABLE_KEYS}
    return rig_values, {path: value for path, value in values.items() if path not in CHANGEABLE_KEYS}


def check_motors(guard: Guard, rig_values: Mapping[str, Any], where: str) -> None:
    """Raise ConfigError if values of an experiment allow more motor heating than the rig."""
    if guard.continuous_force_n is None:
        return
    faults = []
    for key, limit in (("continuous_force_n", guard.continuous_force_n), ("heat_time_s", guard.heat_time_s)):
        value = rig_values.get(f"guard.{key}", limit)
        if value is None or value > limit:
            faults.append(
                f"{where}: {RIG_PREFIX}guard.{key} = {value}: the rig's {limit:g} is the limit of its motors: "
                f"use at most that"
            )
    if faults:
        raise FaultyConfig(faults)


def check_device_limits(values: Iterable[tuple[str, Mapping[str, Any]]], devices: Sequence[DeviceInfo]) -> None:
    """Raise ConfigError if an experiment requires more than a device can display, since the guard would limit it.

    values  location in the design, and the parameters there
    """
    for where, parameters in values:
        for device in devices:
            for key, unit in (("force_max_n", "N"), ("torque_max_nm", "N m")):
                value, limit = parameters.get(f"{RIG_PREFIX}guard.{key}", 0.0), getattr(device, key)
                if value > limit:
                    raise ConfigError(
                        f"{where}: {RIG_PREFIX}guard.{key} = {value:g} {unit}: {device.name} displays "
                        f"{limit:g} {unit}, and more is not sent: use at most that"
                    )


def split_masses(values: Mapping[str, Any]) -> tuple[dict[str, float], dict[str, Any]]:
    """Return masses (kg) by body, and the parameters of the scene."""
    masses = {path.removeprefix(MASS_PREFIX): value for path, value in values.items() if path.startswith(MASS_PREFIX)}
    return masses, {path: value for path, value in values.items() if not path.startswith(MASS_PREFIX)}


def load_changed_scene(source: SceneSource, values: Mapping[str, Any], where: str) -> Scene:
    """Return a scene with changed values and masses; raises ConfigError, with `where`, if it lacks a value."""
    masses, parameters = split_masses(values)
    scene = load_scene(source)
    if not masses:
        return apply_overrides(scene, parameters, where) if parameters else scene
    if scene.world is None:
        raise ConfigError(
            f"{where}: {MASS_PREFIX}{next(iter(masses))}: the scene has no [world], so it has no bodies with a mass"
        )
    changed = apply_overrides(scene, {**parameters, "world.mass_kg": scene.world.mass_kg | masses}, where)
    try:
        return add_objects_of_world(changed)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error
