"""Fixtures for tests of other projects, in a separate pytest that finds them installed."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from helpers.programs import run_program

pytestmark = pytest.mark.real_time

EXAMPLE = Path(__file__).parents[2] / "examples" / "pytest"
LIGHT = """
import sys
before = set(sys.modules)
import softfinger.server.pytest_plugin
heavy = {"numpy", "numba", "zmq", "msgspec", "msgpack", "google", "mcap"} & (set(sys.modules) - before)
sys.exit(f"imported: {heavy}" if heavy else 0)
"""

DIES = """
def test_dies(softfinger_daemon):
    softfinger_daemon(recording="no-such-recording")

def test_is_killed(softfinger_daemon):
    daemon = softfinger_daemon(scene="frictionless-plane", recording="tap")
    daemon.process.kill()
    daemon.process.wait()

def test_asserts(softfinger_daemon):
    daemon = softfinger_daemon(scene="frictionless-plane", recording="tap")
    assert daemon.control.get_state().sequence < 0

def test_is_not_commanded(softfinger_daemon):
    daemon = softfinger_daemon(scene="frictionless-plane", recording="tap", words=["--commands", "off"])
    assert next(iter(daemon.subscribe())).tick >= 0
"""


def run_pytest(folder: Path) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-rA", str(folder)]
    with TemporaryDirectory(prefix="with spaces ") as runtime:  # commands use a socket in it
        environment = os.environ | {"XDG_RUNTIME_DIR": runtime}
        return run_program(words, cwd=folder, env=environment, timeout=600)


def test_the_plugin_imports_no_large_modules() -> None:
    """Every pytest in the environment loads the plugin, so it imports neither a compiler nor NumPy."""
    completed = run_program([sys.executable, "-c", LIGHT])
    assert completed.returncode == 0, completed.stderr


@pytest.mark.exhaustive  # four daemons; `make test` has the fixture's passes and failures below
def test_the_example_project_passes(tmp_path: Path) -> None:
    project = tmp_path / "project"
    shutil.copytree(EXAMPLE, project, ignore=shutil.ignore_patterns("__pycache__"))
    completed = run_pytest(project)
    assert completed.returncode == 0, completed.stdout
    assert "4 passed" in completed.stdout


def test_a_failed_daemon_fails_the_test_with_its_log(tmp_path: Path) -> None:
    (tmp_path / "test_bad.py").write_text(DIES)
    completed = run_pytest(tmp_path)
    assert completed.returncode == 1
    assert "ended with exit code 3" in completed.stdout and "'no-such-recording' is neither a file" in completed.stdout
    assert "ERROR test_bad.py::test_is_killed - Failed: the daemon ended with exit code -9" in completed.stdout
    assert "FAILED test_bad.py::test_asserts" in completed.stdout
    assert "PASSED test_bad.py::test_is_not_commanded" in completed.stdout
    assert "softfinger's log" in completed.stdout and "INFO scene frictionless-plane" in completed.stdout
