"""Notifications of a daemon: to systemd on a datagram socket, and of devices that are plugged in and unplugged."""

import contextlib
import os
import shutil
import signal
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers import faulty_device
from helpers.daemons import make_daemon
from helpers.processes import COMMAND
from helpers.programs import Program, run_program
from helpers.waits import ends_within, eventually, until
from test_devices_verb import plug_hid, plug_serial, plug_usb, root  # noqa: F401  (a fixture)

from softfinger.config.errors import SafetyStop
from softfinger.drivers.system import discovery
from softfinger.drivers.system.discovery import SystemDevice
from softfinger.server import app
from softfinger.server.services import monitoring
from softfinger.server.services.monitoring import HotplugMonitor
from softfinger.server.services.systemd import ServiceNotifier, _read_watchdog_s
from softfinger.server.wire.client import subscribe

pytestmark = pytest.mark.real_time

WATCHDOG_S = 0.4
QUIET_S = 4 * WATCHDOG_S
"""Time without a message after which systemd would have killed a daemon."""
WAIT_S = 300.0
"""A cold start compiles first."""
RUN = [*COMMAND, "run", "--realtime", "off", "--commands", "off"]


class Manager:
    def __init__(self, address: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(address.replace("@", "\0"))
        self.environment = {"NOTIFY_SOCKET": address, "WATCHDOG_USEC": str(int(WATCHDOG_S * 1e6))}

    def receive(self, seconds: float) -> list[str]:
        self._socket.settimeout(seconds)
        try:
            return self._socket.recv(4096).decode().splitlines()
        except TimeoutError:
            return []

    def until(self, line: str) -> list[str]:
        lines: list[str] = []
        until(lambda: lines.extend(self.receive(1.0)) or line in lines, WAIT_S, line)
        return lines

    def falls_silent(self) -> bool:
        return bool(eventually(lambda: not self.receive(QUIET_S), WAIT_S))

    def close(self) -> None:
        self._socket.close()


@pytest.fixture
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Manager]:
    """Socket at a path as for system services; in one test at an abstract name."""
    systemd = Manager(getattr(request, "param", str(tmp_path / "notify")))
    yield systemd
    systemd.close()


def test_a_service_manager_that_reads_nothing_delays_no_end(manager: Manager) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as earlier, contextlib.suppress(BlockingIOError):
        earlier.setblocking(False)
        while True:
            earlier.sendto(b"WATCHDOG=1", manager.environment["NOTIFY_SOCKET"].replace("@", "\0"))
    with ends_within(30):
        ServiceNotifier(None, manager.environment).stop()  # it reads no tick of a servo


def test_ready_and_watchdog_depend_on_ticks(manager: Manager, tmp_path: Path) -> None:
    log_path, environment = tmp_path / "stderr", os.environ | manager.environment
    command = [*RUN, "--endpoint", f"ipc://{tmp_path}/t"]
    with log_path.open("w") as stderr, Program(command, env=environment, stderr=stderr, kill_at_end=True) as process:
        first = manager.until("READY=1")
        ticks = [int(line.split("=")[1].split()[0]) for line in first if line.startswith("STATUS=")]
        assert ticks and ticks[0] > 0
        assert "READY=1" not in manager.until("WATCHDOG=1")
        process.send_signal(signal.SIGSTOP)
        assert manager.falls_silent()
        process.send_signal(signal.SIGCONT)
        manager.until("WATCHDOG=1")
        process.terminate()
        last = manager.until("STOPPING=1")
        assert "WATCHDOG_USEC=0" in last  # a slow shutdown is not mistaken for a hung servo
        assert process.wait(60) == 0, log_path.read_text()


@pytest.mark.parametrize("manager", [f"@softfinger-test-{os.getpid()}"], indirect=True, ids=["abstract"])
def test_a_device_that_hangs_stops_the_watchdog_messages(manager: Manager, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process and its notifying thread are alive, but only ticks count."""
    faulty_device.registered(monkeypatch)
    for name, value in manager.environment.items():
        monkeypatch.setenv(name, value)
    faulty = {"device.driver": "faulty", "device.fault": "hang", "device.at": 1500}
    running = make_daemon(changes=faulty | {"commands.endpoint": "off"})
    (device,) = running.devices
    try:
        running.start()
        manager.until("READY=1")
        assert manager.falls_silent()
        assert running.servo.ticks == 1500
        with pytest.raises(SafetyStop, match="no tick for"):
            running.wait(60.0)
    finally:
        device.release()
        running.close()
    manager.until("STOPPING=1")


def test_a_watchdog_for_another_process_is_ignored() -> None:
    assert _read_watchdog_s({"WATCHDOG_USEC": "2000000"}) == 2.0
    assert _read_watchdog_s({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": str(os.getpid())}) == 2.0
    other = {"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"}
    for environment in ({}, {"WATCHDOG_USEC": "x"}, {"WATCHDOG_USEC": "0"}, {"WATCHDOG_USEC": "-1"}, other):
        assert _read_watchdog_s(environment) == float("inf")


def test_a_missing_manager_does_not_end_the_daemon(manager: Manager, tmp_path: Path) -> None:
    environment = os.environ | manager.environment | {"NOTIFY_SOCKET": str(tmp_path / "gone")}
    command = [*RUN, "--endpoint", f"ipc://{tmp_path}/t", "--duration", "0.5"]
    run_program(command, env=environment, timeout=WAIT_S, check=True)


PUCK = SystemDevice("hid", 0x046D, 0xC626, "Puck", "SN7", "/dev/hidraw3")
TEENSY = SystemDevice("serial", 0x16C0, 0x0483, "Teensy", "SN42", "/dev/ttyACM0")
OMEGA = SystemDevice("usb", 0x1451, 0x0402, "USB device", "", "/dev/bus/usb/001/007")


def test_changes_are_reported_once(root: Path) -> None:  # noqa: F811
    plug_usb(root, "1-1", "1451", "0402")
    hotplug_state = HotplugMonitor(print, root)
    assert hotplug_state._present == [OMEGA] and hotplug_state.changes() == []
    name = plug_hid(root, 3, "0003:0000046D:0000C626")
    assert hotplug_state.changes() == [("attached", PUCK)] and hotplug_state.changes() == []
    shutil.rmtree(root / name)
    shutil.rmtree(root / discovery.USB / "1-1")
    assert hotplug_state.changes() == [("detached", OMEGA), ("detached", PUCK)]
    name = plug_serial(root, "ttyACM0", "16c0", "0483", "SN42")
    assert hotplug_state.changes() == [("attached", TEENSY)]
    shutil.rmtree(root / name)
    assert hotplug_state.changes() == [("detached", TEENSY)] and hotplug_state.changes() == []
    plug_serial(root, "ttyACM5", "16c0", "0483", "SN42", product="Haply inverse3")
    ((change, haply),) = hotplug_state.changes()
    assert (change, monitoring.make_event_fields(haply)["driver"]) == ("attached", "haply")
    assert monitoring.make_event_fields(TEENSY)["driver"] == "serial"


@pytest.mark.parametrize("at_start", [False, True])
def test_a_device_is_reported_when_its_ids_are_readable(at_start: bool, root: Path) -> None:  # noqa: F811
    if at_start:
        (root / discovery.USB / "1-1").mkdir()
    usb = HotplugMonitor(print, root)
    assert usb._present == []
    (root / discovery.USB / "1-1").mkdir(exist_ok=True)
    plug_usb(root, "1-2", "2109", "2813", bDeviceClass="09")
    assert usb.changes() == []
    plug_usb(root, "1-1", "1451", "0402")
    assert usb.changes() == [("attached", OMEGA)]


def test_a_device_plugged_in_before_the_first_poll_is_reported(root: Path) -> None:  # noqa: F811
    plug_usb(root, "1-1", "1451", "0402")
    events: list[tuple[str, Any]] = []

    def event(kind: str, name: str, **fields: Any) -> None:
        assert kind == "device"
        events.append((name, fields["device"]))
        if len(events) == 2:
            watch.closing.set()

    watch = HotplugMonitor(event, root)
    plug_hid(root, 3, "0003:0000046D:0000C626")
    watch.work()
    assert events == [("present", OMEGA.name), ("attached", PUCK.name)]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch, root: Path) -> Iterator[Path]:  # noqa: F811
    monkeypatch.setattr(monitoring, "HOTPLUG_PERIOD_S", 0.02)
    monkeypatch.setattr(app, "HotplugMonitor", lambda event: HotplugMonitor(event, root))
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
        fields = [event[key] for key in ("device", "bus", "ids", "serial", "node", "driver")]
        assert fields == ["Puck", "hid", "046d:c626", "SN7", "/dev/hidraw3", "spacemouse"]
    assert not [thread for thread in threading.enumerate() if thread.name == "hotplug"]
