"""The daemon on Haply's emulated service: closed loop, faults, signals, a missing library, output of tools."""

import contextlib
import os
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.called import called
from helpers.haply_devices import ID, RIG, Service, opened
from helpers.programs import Program, run_program
from helpers.rig_files import load_rig_in_process, write_rig
from helpers.waits import until

from softfinger.config.schema import Rig
from softfinger.config.sources import find
from softfinger.server.verbs.check import examine_file
from softfinger.tools.doctor import attached

pytestmark = pytest.mark.real_time
PATIENT = {"stale_s": 0.2, "quiet_s": 0.2, "timeout_s": 1.0}
"""Times for a busy machine, where a process may answer late."""


def rig(service: Service, **changes: Any) -> Rig:
    return load_rig_in_process(RIG, {"port": service.port, **PATIENT}, changes)


def pushes(service: Service) -> None:
    until(lambda: service.force()[2] >= 0.5, 240.0)  # a process may have to compile first


def command_line(service: Service, folder: Path, endpoint: str) -> list[str]:
    mine = write_rig(folder, RIG, port=service.port, **PATIENT)
    command = [sys.executable, "-m", "softfinger.server.cli", "run", "--rig", str(mine), "--realtime", "off"]
    return [*command, "--scene", "paper-plane", "--endpoint", f"ipc://{folder}/{endpoint}"]


@contextlib.contextmanager
def pushing_daemon(service: Service, folder: Path) -> Iterator[subprocess.Popen[str]]:
    service.do("move", id=ID, to={"x": 0.0, "y": -0.12, "z": 0.159})
    words = command_line(service, folder, "a")
    with Program(words, stderr=subprocess.PIPE, text=True, kill_at_end=True) as running:
        pushes(service)
        yield running


def test_a_killed_daemon_leaves_no_lock_and_no_force(tmp_path: Path) -> None:
    with Service() as service, pushing_daemon(service, tmp_path) as running:
        running.kill()
        running.wait(60)
        opened(service).close()
        until(lambda: not any(service.force()))


def test_a_second_daemon_is_refused_and_an_unconfirmed_zero_is_reported(tmp_path: Path) -> None:
    with Service() as service, pushing_daemon(service, tmp_path) as running:
        second = called(*command_line(service, tmp_path, "b")[3:])
        assert second.returncode == 4
        assert re.search(rf"inverse3 {ID} .* in use by process {running.pid} \(.*end that one first", second.stderr)
        service.do("move", id=ID, to={"x": 0.0, "y": -0.12, "z": 0.1591})  # a static pose has no force
        pushes(service)
        service.set(deaf=True)
        running.send_signal(signal.SIGTERM)
        stderr = running.communicate(timeout=60)[1]
        assert running.returncode == 4, stderr
        assert "zero force is not confirmed" in stderr or "zero force is not confirmed" in stderr
        assert "force is zero" not in stderr


@pytest.mark.exhaustive
def test_a_missing_library_is_one_error(tmp_path: Path) -> None:
    (tmp_path / "websockets.py").write_text("raise ImportError('not installed')")
    environ = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])}
    command = [sys.executable, "-m", "softfinger.server.cli", "run", "-q", "--rig", RIG]
    command += ["--endpoint", f"ipc://{tmp_path}/a"]
    process = run_program(command, env=environ)
    assert process.returncode == 4
    assert len(process.stderr.strip().splitlines()) == 1, process.stderr
    assert "pip install 'softfinger[haply]'" in process.stderr


def test_check_lists_the_filters(tmp_path: Path) -> None:
    mine = tmp_path / "rig.toml"
    text = find(RIG, Rig).read_text()
    mine.write_text(text[: text.index("[device.filters]")] + "[device.filters]\nforce_gate = 0.0\n")
    rows = dict(examine_file(str(mine)).summary)
    assert rows["  filters"].startswith(
        "force gate 0, damping 0, gravity compensation times 1, torque scaling on, home return off"
    )


def test_doctor_queries_the_service() -> None:
    with Service() as service:
        row = attached.check_inverse_service(rig(service))
        assert (row.state, row.seen) == ("good", f"version 3.5.0.0, lists inverse3 {ID}")
        service.do("vanish", id=ID)
        assert attached.check_inverse_service(rig(service)).state == "bad"
    row = attached.check_inverse_service(rig(service))
    assert row.state == "bad" and "systemctl start haply-inverse-service" in row.remedy
