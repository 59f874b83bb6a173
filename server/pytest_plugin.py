"""Pytest fixtures for programs that use the daemon: start it for a test and add its log to the report.

The package installs this plugin (entry point `pytest11`); docs/operate/recordings.md shows its use. Every pytest run in
the same environment imports this module, so it imports large modules only when a fixture is used. The tests for drivers
of other packages are in `softfinger.server.driver_contract`.
"""

from __future__ import annotations

import contextlib
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from softfinger.server.wire.client import Subscription
    from softfinger.server.wire.control import Control

pytest.register_assert_rewrite("softfinger.server.driver_contract")  # a failed case shows both sides

READY_S = 600.0
"""The first run of a scene compiles its kernels, which takes minutes on a busy machine."""
STOP_S = 20.0
_POLL_S = 0.02
_ASK_S = 2.0
_TELEMETRY = re.compile(r"; telemetry on (.+)")
_COMMANDS = re.compile(r"commands on (.+)")
_OFF = "no endpoint: off"
_LOGS = pytest.StashKey[list["SoftfingerDaemon"]]()


class SoftfingerDaemon:
    """Daemon in a separate process on free ports; created by the fixture `softfinger_daemon`."""

    def __init__(self, words: Sequence[str], log: Path) -> None:
        command = [sys.executable, "-m", "softfinger.server.cli", "run", "--endpoint", "tcp://127.0.0.1:*", *words]
        self._log = log
        self._open: list[Any] = []
        with log.open("wb") as file:
            self.process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=file, stderr=file)
        self.endpoint = self.commands = ""
        self._stopped = False

    @property
    def log(self) -> str:
        """Log of the daemon so far."""
        return self._log.read_text("utf-8", "replace")

    @property
    def control(self) -> Control:
        """New client for the daemon's commands, closed by `stop`."""
        from softfinger.server.wire.control import Control

        client = Control(self.commands)
        self._open.append(client)
        return client

    def subscribe(self, topics: Sequence[str] = ("contact",), timeout_s: float = 10.0) -> Subscription:
        """Return a telemetry client; its iterator raises NoTelemetry after `timeout_s` without a message."""
        from softfinger.server.wire.client import subscribe

        client = subscribe(self.endpoint, topics, timeout_s)
        self._open.append(client)
        return client

    def wait(self, timeout_s: float = READY_S) -> int:
        """Wait until the daemon ends, such as at the end of a recording; return the exit code."""
        self._stopped = True
        return self.process.wait(timeout_s)

    def stop(self) -> int:
        """Stop the daemon in an orderly way if it still runs; return the exit code."""
        self._stopped = True
        for client in self._open:
            client.close()
        if self.process.poll() is None:
            self.process.send_signal(signal.SIGTERM)
        try:
            return self.process.wait(STOP_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            return self.process.wait()

    def wait_ready(self, timeout_s: float) -> None:
        """Wait for the first tick; fail the test with the log if the daemon ends before or takes too long."""
        until = time.monotonic() + timeout_s
        while not self._count_ticks():
            if self.process.poll() is not None:
                pytest.fail(f"the daemon ended with exit code {self.process.returncode}:\n{self.log}", pytrace=False)
            if time.monotonic() > until:
                self.stop()
                pytest.fail(f"the daemon was not ready within {timeout_s:g} s:\n{self.log}", pytrace=False)
            time.sleep(_POLL_S)

    @property
    def failed(self) -> str:
        """Message about an unexpected end; empty if there was none."""
        code = self.process.poll()
        return "" if self._stopped or not code else f"the daemon ended with exit code {code}"

    def _count_ticks(self) -> bool:
        if not self.commands:
            text = self.log
            telemetry, commands = _TELEMETRY.search(text), _COMMANDS.search(text)
            if telemetry is None or commands is None:
                return False
            self.endpoint, self.commands = telemetry[1], commands[1]
        from softfinger.config.errors import HapticError
        from softfinger.server.wire.client import subscribe
        from softfinger.server.wire.control import Control

        if self.commands == _OFF:
            with contextlib.suppress(HapticError), subscribe(self.endpoint, ("contact",), _ASK_S) as client:
                next(iter(client))
                return True
            return False
        with contextlib.suppress(HapticError), Control(self.commands, _ASK_S) as control:
            return control.get_state().sequence >= 0
        return False


@pytest.fixture
def softfinger_daemon(request: pytest.FixtureRequest) -> Iterator[Callable[..., SoftfingerDaemon]]:
    """Start daemons: `softfinger_daemon(scene=..., recording=...)` returns a ready one, stopped after the test.

    A daemon that ends with an error fails the test. The report of a failed test has the log of each daemon.

    Parameters
    ----------
    scene
        Shipped name or file.
    recording
        Poses to replay; None: as in the rig.
    device
        Driver that replaces the rig's, such as "simulated".
    rig
        Shipped name or file.
    words
        Further arguments of `softfinger run`, such as ["--once"].
    ready_s
        Time limit for the first tick.
    """
    daemons = request.node.stash.setdefault(_LOGS, [])

    def start(
        scene: str | os.PathLike[str] = "paper-plane",
        recording: str | os.PathLike[str] | None = None,
        *,
        device: str | None = None,
        rig: str | os.PathLike[str] | None = None,
        words: Sequence[str] = (),
        ready_s: float = READY_S,
    ) -> SoftfingerDaemon:
        options = {"--scene": scene, "--recording": recording, "--device": device, "--rig": rig}
        arguments = [word for flag, value in options.items() if value is not None for word in (flag, str(value))]
        log = Path(folder) / f"{len(daemons)}.log"
        daemon = SoftfingerDaemon([*arguments, "--realtime", "off", *words], log)
        daemons.append(daemon)
        daemon.wait_ready(ready_s)
        return daemon

    with tempfile.TemporaryDirectory(prefix="softfinger-") as folder:
        yield start
        problems = [daemon.failed for daemon in daemons if daemon.failed]
        for daemon in daemons:
            daemon.stop()
        logs = "\n".join(daemon.log for daemon in daemons)
    if problems:
        pytest.fail(f"{'; '.join(problems)}:\n{logs}", pytrace=False)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Any:
    report = yield
    if report.when == "call" and report.failed:
        for daemon in item.stash.get(_LOGS, []):
            report.sections.append(("softfinger's log", daemon.log))
    return report
