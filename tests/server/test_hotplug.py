"""Devices plugged in and unplugged: detected in the system's tables, and published by a running daemon."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.daemons import make_daemon
from test_devices_verb import plug_hid, plug_serial, plug_usb, root  # noqa: F401  (a fixture)

from softfinger.drivers.system import discovery
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.server import app
from softfinger.server.services import watches
from softfinger.server.services.watches import Hotplug, HotplugWatch
from softfinger.server.wire.client import subscribe

pytestmark = pytest.mark.real_time

PUCK = SystemDevice("hid", 0x046D, 0xC626, "Puck", "SN7", "/dev/hidraw3")
TEENSY = SystemDevice("serial", 0x16C0, 0x0483, "Teensy", "SN42", "/dev/ttyACM0")
OMEGA = SystemDevice("usb", 0x1451, 0x0402, "USB device", "", "/dev/bus/usb/001/007")


def test_changes_are_reported_once(root: Path) -> None:  # noqa: F811
    plug_usb(root, "1-1", "1451", "0402")
    hotplug_state = Hotplug(root)
    assert hotplug_state.present == [OMEGA]
    assert hotplug_state.changes() == []
    name = plug_hid(root, 3, "0003:0000046D:0000C626")
    assert hotplug_state.changes() == [("attached", PUCK)]
    assert hotplug_state.changes() == []
    shutil.rmtree(root / name)
    shutil.rmtree(root / discovery.USB / "1-1")
    assert hotplug_state.changes() == [("detached", OMEGA), ("detached", PUCK)]
    name = plug_serial(root, "ttyACM0", "16c0", "0483", "SN42")
    assert hotplug_state.changes() == [("attached", TEENSY)]
    shutil.rmtree(root / name)
    assert hotplug_state.changes() == [("detached", TEENSY)]
    assert hotplug_state.changes() == []
    plug_serial(root, "ttyACM5", "16c0", "0483", "SN42", product="Haply inverse3")
    ((change, haply),) = hotplug_state.changes()
    assert (change, watches.make_event_fields(haply)["driver"]) == ("attached", "haply")
    assert watches.make_event_fields(TEENSY)["driver"] == "serial"


@pytest.mark.parametrize("at_start", [False, True])
def test_a_device_is_reported_when_its_ids_are_readable(at_start: bool, root: Path) -> None:  # noqa: F811
    if at_start:
        (root / discovery.USB / "1-1").mkdir()
    usb = Hotplug(root)
    assert usb.present == []
    (root / discovery.USB / "1-1").mkdir(exist_ok=True)
    plug_usb(root, "1-2", "2109", "2813", bDeviceClass="09")
    assert usb.changes() == []
    plug_usb(root, "1-1", "1451", "0402")
    assert usb.changes() == [("attached", OMEGA)]


def test_a_device_plugged_in_before_the_first_poll_is_reported(root: Path) -> None:  # noqa: F811
    plug_usb(root, "1-1", "1451", "0402")
    usb = Hotplug(root)
    plug_hid(root, 3, "0003:0000046D:0000C626")
    events: list[tuple[str, Any]] = []

    def event(kind: str, name: str, **fields: Any) -> None:
        assert kind == "device"
        events.append((name, fields["device"]))
        if len(events) == 2:
            watch.closing.set()

    watch = HotplugWatch(usb, event)
    watch.work()
    assert events == [("present", OMEGA.name), ("attached", PUCK.name)]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch, root: Path) -> Iterator[Path]:  # noqa: F811
    monkeypatch.setattr(watches, "PERIOD_S", 0.02)
    monkeypatch.setattr(app, "Hotplug", lambda: Hotplug(root))
    return root


def test_a_running_daemon_publishes_hotplug_events(quick: Path) -> None:
    events: list[dict[str, Any]] = []
    with make_daemon() as daemon:
        with subscribe(daemon.publisher.endpoint, ("event",), timeout_s=20.0) as samples:
            while samples.receive(0.01) is None:  # until the subscription has taken effect
                daemon.publisher.event("test", "joined")
            name = plug_hid(quick, 3, "0003:0000046D:0000C626")  # the daemon's threads start later
            daemon.start()
            until = time.monotonic() + 20.0  # other events arrive, too
            for sample in samples:
                assert time.monotonic() < until, events
                if sample["kind"] == "device":
                    events.append(sample.as_map())
                    if len(events) == 2:
                        break
                    shutil.rmtree(quick / name)
        assert daemon.servo.is_running
    attached, detached = events
    assert attached["name"] == "attached" and detached["name"] == "detached"
    for event in events:
        fields = {key: event[key] for key in ("device", "bus", "ids", "serial", "node", "driver")}
        assert fields == {
            "device": "Puck", "bus": "hid", "ids": "046d:c626", "serial": "SN7", "node": "/dev/hidraw3",
            "driver": "spacemouse",
        }  # fmt: skip
    assert not [thread for thread in threading.enumerate() if thread.name == "hotplug"]
