"""What systemd is told, on a real datagram socket: by the daemon as a process, and by one whose device hangs."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from helpers import faulty_device

from softfinger.config.errors import SafetyStop
from softfinger.config.load import load_rig, load_scene
from softfinger.drivers import registry
from softfinger.server.app import Daemon
from softfinger.server.services.notify import _watchdog_s

pytestmark = pytest.mark.real_time

WATCHDOG_S = 0.4
QUIET_S = 4 * WATCHDOG_S
"""Long enough that systemd would have ended a daemon which says nothing."""
WAIT_S = 300.0
"""A cold start compiles first."""


class Manager:
    """systemd's end of NOTIFY_SOCKET."""

    def __init__(self, address: str) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(address.replace("@", "\0"))
        self.environment = {"NOTIFY_SOCKET": address, "WATCHDOG_USEC": str(int(WATCHDOG_S * 1e6))}

    def told(self, seconds: float) -> list[str]:
        """The lines of the next message, none if none comes in time."""
        self._socket.settimeout(seconds)
        try:
            return self._socket.recv(4096).decode().splitlines()
        except TimeoutError:
            return []

    def until(self, line: str, before: Callable[[], None] = lambda: None) -> list[str]:
        """Every line up to one that is expected; `before` is called first."""
        before()
        seen: list[str] = []
        end = time.monotonic() + WAIT_S
        while line not in seen:
            assert time.monotonic() < end, seen
            seen += self.told(1.0)
        return seen

    def falls_silent(self) -> bool:
        """Whether nothing more is told for so long that systemd would act; what was under way is passed over."""
        end = time.monotonic() + WAIT_S
        while self.told(QUIET_S):
            if time.monotonic() > end:
                return False
        return True

    def close(self) -> None:
        self._socket.close()


REST = pytest.mark.exhaustive
ABSTRACT = pytest.mark.parametrize("manager", ["abstract", pytest.param("path", marks=REST)], indirect=True)
"""By an abstract name; elsewhere on a path, as for the system's services. What is told is the same."""


@pytest.fixture(params=["path", pytest.param("abstract", marks=REST)])
def manager(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Manager]:
    """A service manager that listens."""
    one = Manager(str(tmp_path / "notify") if request.param == "path" else f"@softfinger-test-{os.getpid()}")
    yield one
    one.close()


def test_a_daemon_is_ready_with_ticks_and_alive_by_them(manager: Manager, tmp_path: Path) -> None:
    """READY comes with ticks, the sign of life goes, stops and comes back with them; STOPPING at the end."""
    words = ["--realtime", "off", "--endpoint", f"ipc://{tmp_path}/t", "--commands", "off"]
    command = [sys.executable, "-m", "softfinger.server.cli", "run", *words]
    said = tmp_path / "stderr"
    with said.open("w") as stderr:
        process = subprocess.Popen(command, env=os.environ | manager.environment, stderr=stderr)
    try:
        first = manager.until("READY=1")
        ticks = [int(line.split("=")[1].split()[0]) for line in first if line.startswith("STATUS=")]
        assert ticks and ticks[0] > 0
        assert "READY=1" not in manager.until("WATCHDOG=1")
        process.send_signal(signal.SIGSTOP)
        assert manager.falls_silent()
        process.send_signal(signal.SIGCONT)
        manager.until("WATCHDOG=1")
        last = manager.until("STOPPING=1", process.terminate)
        assert "WATCHDOG_USEC=0" in last  # a closing that takes its time is not taken for a servo that hangs
        assert process.wait(60) == 0, said.read_text()
    finally:
        process.kill()
        process.wait()


@ABSTRACT
def test_a_device_that_hangs_ends_the_sign_of_life(manager: Manager, monkeypatch: pytest.MonkeyPatch) -> None:
    """The process lives and this thread with it, and says nothing: only ticks count."""
    load = registry.load
    monkeypatch.setattr(registry, "load", lambda name: faulty_device if name == "faulty" else load(name))
    for name, value in manager.environment.items():
        monkeypatch.setenv(name, value)
    keys = {"telemetry.endpoint": "tcp://127.0.0.1:*", "commands.endpoint": "off", "servo.realtime": "off"}
    faulty = {"device.driver": "faulty", "device.fault": "hang", "device.at": 1500}
    running = Daemon(load_rig("replay", keys | faulty), load_scene("paper-plane"))
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


def test_a_watchdog_for_another_process_is_none() -> None:
    """WATCHDOG_PID of another process, or no watchdog at all: a state once a second, as for `systemctl status`."""
    assert _watchdog_s({"WATCHDOG_USEC": "2000000"}) == 2.0
    assert _watchdog_s({"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": str(os.getpid())}) == 2.0
    for environment in ({}, {"WATCHDOG_USEC": "x"}, {"WATCHDOG_USEC": "2000000", "WATCHDOG_PID": "1"}):
        assert _watchdog_s(environment) == float("inf")


def test_a_manager_that_has_gone_ends_nothing(manager: Manager, tmp_path: Path) -> None:
    """The daemon runs to its last tick although nobody hears it."""
    environment = os.environ | manager.environment | {"NOTIFY_SOCKET": str(tmp_path / "gone")}
    words = ["--realtime", "off", "--endpoint", f"ipc://{tmp_path}/t", "--commands", "off", "--duration", "0.5"]
    command = [sys.executable, "-m", "softfinger.server.cli", "run", *words]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=WAIT_S)
    assert done.returncode == 0, done.stderr
