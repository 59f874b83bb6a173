"""Every driver that needs no hardware, held to the contract; and finding drivers by name."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import metadata
from typing import Any

import pytest
from driver_contract import DriverContract

from softfinger.config.errors import DeviceError, DeviceNotFound
from softfinger.drivers import registry
from softfinger.drivers.base import Device

OPTIONS: dict[str, dict[str, Any]] = {
    "replay": {"recording": "tap"},
    "simulated": {"recording": "tap"},
}


@pytest.fixture(params=sorted(OPTIONS))
def device(request: pytest.FixtureRequest) -> Iterator[Device]:
    driver = registry.load(request.param)
    with driver.open_device(driver.Options(**OPTIONS[request.param]), 1000.0) as opened:
        yield opened


class TestContract(DriverContract):
    """The contract over every driver in OPTIONS."""


def test_built_in_drivers_load() -> None:
    """Every built-in name leads to a module with Options and open_device."""
    assert set(OPTIONS) <= set(registry.names())
    for name in registry.BUILT_IN:
        driver = registry.load(name)
        assert hasattr(driver, "Options")
        assert hasattr(driver, "open_device")


def test_unknown_driver_is_named_with_a_suggestion() -> None:
    """A misspelt driver is refused with the names that exist and the nearest one."""
    with pytest.raises(DeviceNotFound, match=r"'repley'.*did you mean 'replay'.*replay"):
        registry.load("repley")


def test_outside_driver_comes_by_entry_point(monkeypatch: pytest.MonkeyPatch, tmp_path: Any) -> None:
    """A driver of another installed package is listed and loaded; one that is no driver, or that cannot be
    imported, is refused by name."""
    (tmp_path / "outside.py").write_text("Options = object\ndef open_device(options, rate_hz): ...\n")
    info = tmp_path / "outside-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: outside\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        f"[{registry.ENTRY_POINT_GROUP}]\nmydevice = outside\nplain = json\nbroken = no_such_module_here\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    assert metadata.distribution("outside").version == "1.0"
    assert {"replay", "mydevice"} <= set(registry.names())
    assert registry.load("mydevice").__name__ == "outside"
    with pytest.raises(DeviceError, match=r"'plain' \(json\).*Options, open_device"):
        registry.load("plain")
    with pytest.raises(DeviceError, match="no_such_module_here"):
        registry.load("broken")
