"""Plugging in and pulling out: noticed from the system's tables, and published by a running daemon."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from test_devices_verb import plug_hid, plug_serial, plug_usb, root  # noqa: F401  (a fixture)

from softfinger.config.load import load_rig, load_scene
from softfinger.drivers import discovery
from softfinger.drivers.discovery import Attached
from softfinger.server import hotplug
from softfinger.server.app import Daemon
from softfinger.server.client import subscribe
from softfinger.server.hotplug import Hotplug

PUCK = Attached("hid", 0x046D, 0xC626, "Puck", "SN7", "/dev/hidraw3")
TEENSY = Attached("serial", 0x16C0, 0x0483, "Teensy", "SN42", "/dev/ttyACM0")
OMEGA = Attached("usb", 0x1451, 0x0402, "USB device", "", "/dev/bus/usb/001/007")


def test_changes_are_told_once(root: Path) -> None:  # noqa: F811
    """What was there at the start is no news; what comes is attached, what goes detached, each once."""
    plug_usb(root, "1-1", "1451", "0402")
    seen = Hotplug(root)
    assert seen.changes() == []
    name = plug_hid(root, 3, "0003:0000046D:0000C626")
    assert seen.changes() == [("attached", PUCK)]
    assert seen.changes() == []
    shutil.rmtree(root / name)
    shutil.rmtree(root / discovery.USB / "1-1")
    assert seen.changes() == [("detached", OMEGA), ("detached", PUCK)]
    name = plug_serial(root, "ttyACM0", "16c0", "0483", "SN42")
    assert seen.changes() == [("attached", TEENSY)]
    shutil.rmtree(root / name)
    assert seen.changes() == [("detached", TEENSY)]
    assert seen.changes() == []


def test_a_device_is_told_when_its_ids_can_be_read(root: Path) -> None:  # noqa: F811
    """Listed before the kernel has filled its entry in, it is reported by a later look; a hub never is."""
    seen = Hotplug(root)
    (root / discovery.USB / "1-1").mkdir()
    plug_usb(root, "1-2", "2109", "2813", bDeviceClass="09")
    assert seen.changes() == []
    plug_usb(root, "1-1", "1451", "0402")
    assert seen.changes() == [("attached", OMEGA)]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch, root: Path) -> Iterator[Path]:  # noqa: F811
    """A daemon that looks at the folder, often."""
    monkeypatch.setattr(hotplug, "PERIOD_S", 0.02)
    watch = hotplug.watch
    monkeypatch.setattr(hotplug, "watch", lambda event, closing: watch(event, closing, root))
    return root


def test_a_running_daemon_publishes_them(quick: Path) -> None:
    """A puck plugged in and pulled out while the servo runs is two events with its name, ids, node and driver; the
    servo is not disturbed and the thread ends with the daemon."""
    events: list[dict[str, Any]] = []
    rig = load_rig("replay", {"telemetry.endpoint": "tcp://127.0.0.1:*", "servo.realtime": "off"})
    with Daemon(rig, load_scene("paper-plane")) as daemon:
        with subscribe(daemon.publisher.endpoint, ("event",), timeout_s=20.0) as samples:
            daemon.start()
            while samples.receive(0.01) is None:  # until the subscription has taken effect
                daemon.publisher.event("test", "joined")
            name = plug_hid(quick, 3, "0003:0000046D:0000C626")
            for sample in samples:
                if sample["kind"] == "device":
                    events.append(sample.as_map())
                    if len(events) == 2:
                        break
                    shutil.rmtree(quick / name)
        assert daemon.servo.running
    attached, detached = events
    assert attached["name"] == "attached" and detached["name"] == "detached"
    for event in events:
        told = {key: event[key] for key in ("device", "bus", "ids", "serial", "node", "driver")}
        assert told == {
            "device": "Puck", "bus": "hid", "ids": "046d:c626", "serial": "SN7", "node": "/dev/hidraw3",
            "driver": "spacemouse",
        }  # fmt: skip
    assert not [thread for thread in threading.enumerate() if thread.name == "hotplug"]
