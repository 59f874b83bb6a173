"""Notifications to systemd on a datagram socket, from a daemon process and from one whose device hangs."""

from __future__ import annotations

import contextlib
import os
import signal
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from helpers import faulty_device
from helpers.daemons import make_daemon
from helpers.processes import COMMAND
from helpers.programs import Program, run_program
from helpers.waits import eventually, until

from softfinger.config.errors import SafetyStop
from softfinger.server.services.notify import ServiceNotifier, _read_watchdog_s

pytestmark = pytest.mark.real_time

WATCHDOG_S = 0.4
QUIET_S = 4 * WATCHDOG_S
"""Time without a message after which systemd would have killed a daemon."""
WAIT_S = 300.0
"""A cold start compiles first."""


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
    ServiceNotifier(None, manager.environment).stop()  # it reads no tick of a servo


def test_ready_and_watchdog_depend_on_ticks(manager: Manager, tmp_path: Path) -> None:
    words = ["--realtime", "off", "--endpoint", f"ipc://{tmp_path}/t", "--commands", "off"]
    command = [*COMMAND, "run", *words]
    log_path = tmp_path / "stderr"
    environment = os.environ | manager.environment
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
    assert isinstance(device, faulty_device.FaultyDevice)
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
    for environment in ({}, {"WATCHDOG_USEC": "x"}, {"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"}):
        assert _read_watchdog_s(environment) == float("inf")


def test_a_missing_manager_does_not_end_the_daemon(manager: Manager, tmp_path: Path) -> None:
    environment = os.environ | manager.environment | {"NOTIFY_SOCKET": str(tmp_path / "gone")}
    words = ["--realtime", "off", "--endpoint", f"ipc://{tmp_path}/t", "--commands", "off", "--duration", "0.5"]
    command = [*COMMAND, "run", *words]
    completed = run_program(command, env=environment, timeout=WAIT_S)
    assert completed.returncode == 0, completed.stderr
