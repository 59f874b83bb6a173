"""Drivers by name: built in, or provided by another package through an entry point.

A driver is a module with `Options` (a msgspec Struct of the keys in a rig's [device] table) and
`open_device(options, rate_hz) -> Device`. It is imported on first use, so that a missing vendor library affects only
the devices that need it.
"""

from __future__ import annotations

import difflib
import importlib
from importlib import metadata
from types import ModuleType
from typing import Any, Final

from softfinger.config.errors import DeviceError, DeviceNotFound
from softfinger.config.load import build
from softfinger.config.schema import DeviceConfig
from softfinger.drivers import open_devices
from softfinger.drivers.base import Device

ENTRY_POINT_GROUP: Final = "softfinger.drivers"
BUILT_IN: Final = (
    "falcon", "forcedimension", "haply", "hid", "openhaptics", "replay", "serial", "simulated", "spacemouse",
)  # fmt: skip
"""Names of folders here; module `device` in each is the driver."""
_registered: Final[dict[str, ModuleType]] = {}


def list_names() -> list[str]:
    """Return the names of all drivers: built in, then added by this program and by installed packages."""
    return [*BUILT_IN, *sorted({*_registered, *_find_entry_points()} - set(BUILT_IN))]


def add(name: str, module: ModuleType) -> None:
    """Register a module of the running program as driver `name`, for rigs in this process.

    Raises DeviceError if the module is not a driver, or if the name is that of a built in driver.
    """
    if name in BUILT_IN:
        raise DeviceError(f"driver '{name}' is built in: rename yours")
    _registered[name] = _check_driver(name, module, f"module {module.__name__}")


def load(name: str) -> ModuleType:
    """Import the driver `name`.

    Raises DeviceNotFound if there is no such driver, DeviceError if it cannot be imported or is not a driver.
    """
    if name in BUILT_IN:
        return importlib.import_module(f"softfinger.drivers.{name}.device")
    if name in _registered:
        return _registered[name]
    entry = _find_entry_points().get(name)
    if entry is None:
        driver_names = list_names()
        close = difflib.get_close_matches(name, driver_names, n=1)
        hint = f" (did you mean '{close[0]}'?)" if close else ""
        raise DeviceNotFound(
            f"no driver is called '{name}'{hint}; drivers are {', '.join(driver_names)}; "
            "install the package of another driver"
        )
    try:
        module = entry.load()
    except Exception as error:  # the import of another package may raise any error
        raise DeviceError(
            f"driver '{name}' ({entry.value}) cannot be imported: {error}: "
            "repair or reinstall the package that provides it"
        ) from error
    return _check_driver(name, module, f"{entry.value}, an entry point in group '{ENTRY_POINT_GROUP}'")


def read_options(config: DeviceConfig, where: str = "[device]") -> Any:
    """Return a rig's [device] table as the Options of its driver; raises ConfigError for an invalid key or value."""
    return build(load(config.driver).Options, config.options, where)


def check(config: DeviceConfig, rate_hz: float, where: str = "[device]") -> Any:
    """Return the Options of a [device] table; raises ConfigError if the driver rejects them or the rate (Hz)."""
    driver_options = read_options(config, where)
    check_options = getattr(load(config.driver), "check", None)
    if check_options is not None:
        check_options(driver_options, rate_hz, where)
    return driver_options


def open_device(config: DeviceConfig, rate_hz: float, where: str = "[device]") -> Device:
    """Open the device that a rig describes; raises ConfigError for invalid options, with their location `where`.

    A signal that stops the process zeroes the device; one that ends the process from another thread closes it.
    """
    driver, driver_options = load(config.driver), check(config, rate_hz, where)
    open_devices.reserve_threads()
    device: Device = driver.open_device(driver_options, rate_hz)
    open_devices.devices.add(device)
    return device


def _check_driver(name: str, module: Any, source: str) -> ModuleType:
    missing = [part for part in ("Options", "open_device") if not hasattr(module, part)]
    if missing or not isinstance(module, ModuleType):
        raise DeviceError(
            f"driver '{name}' ({source}) is not a driver module: it lacks {', '.join(missing) or 'a module'}"
        )
    return module


def _find_entry_points() -> dict[str, metadata.EntryPoint]:
    return {entry.name: entry for entry in metadata.entry_points(group=ENTRY_POINT_GROUP)}
