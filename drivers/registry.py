"""Drivers by name: built in, or added by another package through an entry point.

A driver is a module with `Options` (a msgspec Struct, what a rig's [device] table may say) and
`open_device(options, rate_hz) -> Device`. It is imported when it is asked for, so that a vendor
library missing on this machine costs nothing until its device is wanted.
"""

from __future__ import annotations

import difflib
import importlib
from importlib import metadata
from types import ModuleType
from typing import Final

from softfinger.config.errors import DeviceError, DeviceNotFound

ENTRY_POINT_GROUP: Final = "softfinger.drivers"
BUILT_IN: Final = {
    "falcon": "softfinger.drivers.falcon",
    "forcedimension": "softfinger.drivers.forcedimension",
    "hid": "softfinger.drivers.hid",
    "replay": "softfinger.drivers.replay",
    "serial": "softfinger.drivers.serial",
    "simulated": "softfinger.drivers.simulated",
    "spacemouse": "softfinger.drivers.spacemouse",
}


def names() -> list[str]:
    """Every driver that can be asked for: built in ones first, then those of installed packages."""
    return [*BUILT_IN, *sorted(set(_outside()) - set(BUILT_IN))]


def load(name: str) -> ModuleType:
    """Import the driver `name`.

    Raises DeviceNotFound when there is no such driver, DeviceError when it cannot be imported or
    is not a driver.
    """
    if name in BUILT_IN:
        return importlib.import_module(BUILT_IN[name])
    entry = _outside().get(name)
    if entry is None:
        raise DeviceNotFound(_unknown(name))
    try:
        module = entry.load()
    except Exception as error:  # another package's import may fail in any way
        raise DeviceError(
            f"driver '{name}' ({entry.value}) cannot be imported: {error}: "
            "repair or reinstall the package that provides it"
        ) from error
    missing = [part for part in ("Options", "open_device") if not hasattr(module, part)]
    if missing or not isinstance(module, ModuleType):
        raise DeviceError(
            f"driver '{name}' ({entry.value}) is not a driver module: it lacks {', '.join(missing) or 'a module'}; "
            f"its entry point in group '{ENTRY_POINT_GROUP}' must name a module with Options and open_device"
        )
    return module


def _outside() -> dict[str, metadata.EntryPoint]:
    return {entry.name: entry for entry in metadata.entry_points(group=ENTRY_POINT_GROUP)}


def _unknown(name: str) -> str:
    known = names()
    close = difflib.get_close_matches(name, known, n=1)
    hint = f"did you mean '{close[0]}'? " if close else ""
    return f"no driver is called '{name}': {hint}Drivers are {', '.join(known)}"
