"""Driver contract over the drivers that need no hardware; registry of drivers; driver of an installed package."""

import os
from collections.abc import Mapping
from importlib import metadata
from pathlib import Path
from typing import Any, ClassVar

import pytest

from softfinger.config.errors import DeviceError, DeviceNotFound, HapticError, RecordingError
from softfinger.config.load import load_rig
from softfinger.drivers import open_devices, registry
from softfinger.drivers.base import OK, WITHHELD, Device
from softfinger.server.driver_contract import RATE_HZ, REFUSALS, Bench, DeviceCaller, DriverContract


class ReplayBench(Bench):
    cannot: ClassVar[Mapping[str, str]] = {
        "busy": "a recording is read, so any number of processes may have it",
        "permission": "a recording that cannot be read is one that is not there",
        "lost": "nothing is attached that could go",
        "timeout": "the samples are in memory",
    }
    refusals: ClassVar[Mapping[str, type[HapticError]]] = {**REFUSALS, "not_found": RecordingError}

    def __init__(self, name: str) -> None:
        self.driver = registry.load(name)
        self.recording = "tap"
        self.device: Any = None

    def open(self) -> Device:
        self.device = self.driver.open_device(self.driver.Options(recording=self.recording), RATE_HZ)
        return self.device

    def displayed(self) -> tuple[float, ...]:
        return tuple(self.device.read_log().wrench[-1].tolist())

    def make(self, case: str) -> None:
        self.recording = "no-such-recording"

    def mend(self) -> None:
        self.recording = "tap"


@pytest.fixture(params=["replay", "simulated"])
def bench(request: pytest.FixtureRequest) -> Bench:
    return ReplayBench(request.param)


class TestContract(DriverContract):
    """The contract over `replay` and `simulated`."""


def test_unknown_driver_is_named_with_a_suggestion() -> None:
    with pytest.raises(DeviceNotFound, match=r"'repley'.*did you mean 'replay'.*replay"):
        registry.load("repley")


def test_unusable_outside_drivers_are_refused_by_name(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    info = tmp_path / "outside-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: outside\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        f"[{registry.ENTRY_POINT_GROUP}]\nplain = json\nbroken = no_such_module_here\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    assert metadata.distribution("outside").version == "1.0"
    assert {"replay", "plain", "broken"} <= set(registry.list_names())
    with pytest.raises(DeviceError, match=r"'plain' \(json, an entry point.*Options, open_device"):
        registry.load("plain")
    with pytest.raises(DeviceError, match="no_such_module_here"):
        registry.load("broken")


def test_a_program_can_register_a_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry, "_registered", {})
    replay = registry.load("replay")
    registry.add("mine", replay)
    assert registry.load("mine") is replay and "mine" in registry.list_names()
    with pytest.raises(DeviceError, match=r"'other' \(module os\).*Options, open_device"):
        registry.add("other", os)
    with pytest.raises(DeviceError, match="'replay' is built in"):
        registry.add("replay", replay)


def test_a_device_of_a_rig_is_stopped_with_all_that_are_open() -> None:
    config = load_rig("replay").device
    with registry.open_device(config, RATE_HZ) as device:
        servo = DeviceCaller(device)
        servo.read()
        assert servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0) == OK
        assert open_devices.stop_all() == []
        assert servo.write(0.0, 0.0, 1.0, 0.0, 0.0, 0.0) == WITHHELD
