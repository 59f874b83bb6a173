"""Values of the rig as parameters: `rig.guard.KEY`, which a running daemon takes from zero force on."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Final

from msgspec.structs import fields

from softfinger.config.errors import ConfigError
from softfinger.config.schema import Guard, Rig, Scene

if TYPE_CHECKING:  # a file of an experiment is read without drivers
    from softfinger.drivers.base import DeviceInfo

PREFIX: Final = "rig."
FIXED: Final = frozenset({"arm", "workspace"})
"""Of the guard: who may arm is no stimulus, and a workspace is compiled."""
CHANGING: Final = frozenset(f"{PREFIX}guard.{each.name}" for each in fields(Guard) if each.name not in FIXED)
"""What can change between two touches; the devices stay open."""
_TABLES: Final = {each.name for each in fields(Rig)} - {each.name for each in fields(Scene)}


def split(values: Mapping[str, Any], where: str) -> tuple[dict[str, Any], dict[str, Any]]:
    """Values of the rig by its dotted key, and the parameters that are a scene's.

    Raises ConfigError for a value of the rig that needs another start of the daemon.
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
    """Raise ConfigError where values of an experiment have motors heat more than the rig says that they bear."""
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
    """Raise ConfigError where an experiment asks for more than a device displays: the guard would let less through.

    values  where in the design, and the parameters there
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
