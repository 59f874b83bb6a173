"""Values of the rig as experiment parameters, `rig.guard.KEY`; a running daemon changes them at zero force."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from msgspec.structs import fields

from softfinger.config.errors import ConfigError
from softfinger.config.load import FaultyConfig
from softfinger.config.schema import Guard, Rig, Scene

if TYPE_CHECKING:  # experiment files are read without importing drivers
    from softfinger.drivers.base import DeviceInfo

PREFIX: Final = "rig."
FIXED_KEYS: Final = frozenset({"arm", "workspace"})
"""Keys of the guard that cannot be parameters: the right to arm is not a stimulus, and a workspace is compiled."""
CHANGEABLE_KEYS: Final = frozenset(
    f"{PREFIX}guard.{field.name}" for field in fields(Guard) if field.name not in FIXED_KEYS
)
"""Parameters that can change between two touches; the devices remain open."""
_TABLES: Final = {field.name for field in fields(Rig)} - {field.name for field in fields(Scene)}


def split(values: Mapping[str, Any], where: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the values of the rig by dotted key, and the parameters of the scene.

    Raises ConfigError if a value of the rig needs a restart of the daemon.
    """
    faults = [
        f"{where}: {path}: needs another start of the daemon, so it is not a factor: run a session with --rig for "
        f"each of its levels; of the rig there are {', '.join(sorted(CHANGEABLE_KEYS))}"
        for path in values
        if (path.startswith(PREFIX) or path.partition(".")[0] in _TABLES) and path not in CHANGEABLE_KEYS
    ]
    if faults:
        raise FaultyConfig(faults)
    rig_values = {path.removeprefix(PREFIX): value for path, value in values.items() if path in CHANGEABLE_KEYS}
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
                f"{where}: {PREFIX}guard.{key} = {value}: the rig's {limit:g} is the limit of its motors: "
                f"give at most that"
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
                value, limit = parameters.get(f"{PREFIX}guard.{key}", 0.0), getattr(device, key)
                if value > limit:
                    raise ConfigError(
                        f"{where}: {PREFIX}guard.{key} = {value:g} {unit}: {device.name} displays {limit:g} {unit}, "
                        "and more is not let through: give no more than that"
                    )
