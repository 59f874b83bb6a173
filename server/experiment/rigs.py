"""Values of the rig as experiment parameters, `rig.guard.KEY`; a running daemon changes them at zero force."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from msgspec.structs import fields

from softfinger.config.errors import ConfigError
from softfinger.config.schema import Guard, Rig, Scene

if TYPE_CHECKING:  # experiment files are read without importing drivers
    from softfinger.drivers.base import DeviceInfo

PREFIX: Final = "rig."
FIXED: Final = frozenset({"arm", "workspace"})
"""Keys of the guard that cannot be parameters: the right to arm is no stimulus, and a workspace is compiled."""
CHANGING: Final = frozenset(f"{PREFIX}guard.{each.name}" for each in fields(Guard) if each.name not in FIXED)
"""Parameters that can change between two touches; the devices remain open."""
_TABLES: Final = {each.name for each in fields(Rig)} - {each.name for each in fields(Scene)}


def split(values: Mapping[str, Any], where: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return the values of the rig by dotted key, and the parameters of the scene.

    Raises ConfigError if a value of the rig needs a restart of the daemon.
    """
    for path in values:
        of_rig = path.startswith(PREFIX) or path.partition(".")[0] in _TABLES
        if of_rig and path not in CHANGING:
            raise ConfigError(
                f"{where}: {path}: needs another start of the daemon, so it is no factor: run a session with --rig for "
                f"each of its levels; of the rig there are {', '.join(sorted(CHANGING))}"
            )
    ours = {path.removeprefix(PREFIX): value for path, value in values.items() if path in CHANGING}
    return ours, {path: value for path, value in values.items() if path not in CHANGING}


def check_motors(guard: Guard, ours: Mapping[str, Any], where: str) -> None:
    """Raise ConfigError if values of an experiment allow more motor heating than the rig."""
    if guard.continuous_force_n is None:
        return
    for key, most in (("continuous_force_n", guard.continuous_force_n), ("heat_time_s", guard.heat_time_s)):
        value = ours.get(f"guard.{key}", most)
        if value is None or value > most:
            raise ConfigError(
                f"{where}: {PREFIX}guard.{key} = {value}: the rig's {most:g} is what its motors bear: "
                f"give no more than that"
            )


def check_rated(values: Iterable[tuple[str, Mapping[str, Any]]], devices: Sequence[DeviceInfo]) -> None:
    """Raise ConfigError if an experiment requires more than a device can display, since the guard would limit it.

    values  location in the design, and the parameters there
    """
    for where, parameters in values:
        for device in devices:
            for key, unit in (("force_max_n", "N"), ("torque_max_nm", "N m")):
                value, most = parameters.get(f"{PREFIX}guard.{key}", 0.0), getattr(device, key)
                if value > most:
                    raise ConfigError(
                        f"{where}: {PREFIX}guard.{key} = {value:g} {unit}: {device.name} displays {most:g} {unit}, and "
                        "more is not let through: give no more than that"
                    )
