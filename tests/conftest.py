"""Fixtures of all tests: scenes built from the same mappings as scene files, and isolation of the tests."""

import gc
import os
import re
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from helpers.cpu_report import CpuReport
from helpers.stalls import Patience
from hypothesis import HealthCheck, settings

from softfinger.config.load import build
from softfinger.config.schema import Scene
from softfinger.config.schema.addresses import IPC_PATH_MAX
from softfinger.drivers import open_devices

gc.disable()
"""Until the tests are imported, which then takes two thirds of the CPU time: see `pytest_collection`."""

pytest_plugins = ["helpers.pages"]
collect_ignore = ["outside_driver"]
"""A separate package, whose tests need it installed: tests/test_packaging.py runs them."""

os.environ.pop("PYTHONUNBUFFERED", None)
"""Machines for builds set it: programs would have nothing left to write when they end, as they have for their users."""

# The same cases in every run, however long each takes on a busy machine.
settings.register_profile(
    "suite", deadline=None, derandomize=True, suppress_health_check=[HealthCheck.too_slow]
)  # fmt: skip
settings.register_profile("full", settings.get_profile("suite"))  # tests/proxy/test_invariants.py explains it
settings.load_profile("suite")

# A shell ignores two of these signals in background processes, and nohup ignores the third. The program inherits that,
# and so would every process that a test starts and then signals.
for _number in (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, signal.default_int_handler if _number == signal.SIGINT else signal.SIG_DFL)


@pytest.fixture(scope="session", autouse=True)
def _runtime_folder() -> Iterator[None]:
    """Use separate folders for command sockets and black box files, with short paths, as sockets need them."""
    with tempfile.TemporaryDirectory(prefix="softfinger-") as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_RUNTIME_DIR", folder)
        patch.setenv("SOFTFINGER_BLACKBOX_DIR", f"{folder}/blackbox")
        yield


@pytest.fixture
def tmp_path(tmp_path: Path) -> Iterator[Path]:
    """Folder for a test's sockets; shorter than pytest's if the length of a socket's path would not suffice."""
    if len(os.fsencode(tmp_path / "telemetry.commands")) <= IPC_PATH_MAX:
        yield tmp_path
        return
    with tempfile.TemporaryDirectory(prefix="söft finger ", dir="/tmp") as folder:
        yield Path(folder)


@pytest.fixture(autouse=True)
def _no_device_of_another_test() -> Iterator[None]:
    """Prevent the next test's program from stopping a device that an earlier test left hanging."""
    yield
    open_devices.devices.clear()


def pytest_addoption(parser: pytest.Parser) -> None:
    group = parser.getgroup("softfinger")
    group.addoption("--cpu-report", metavar="FILE", help="write the CPU seconds of each test here, as JSON")
    group.addoption("--exhaustive", action="store_true", help="all cases of tests marked `scaled`")
    group.addoption("--put-off", metavar="FILE", help="name tests of real time here that failed")
    group.addoption("--files", choices=["server", "others"], help="tests in tests/server itself, or all others")


def is_in_part(path: Path, config: pytest.Config) -> bool:
    """Return whether a test file is one of `--files`."""
    files = config.getoption("--files")
    return files is None or (files == "server") == (path.parent.name == "server")


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """Skip the import of files in which the marks of the command line select no test: importing all takes 20 CPU s."""
    if not collection_path.match("test_*.py"):
        return None
    if not is_in_part(collection_path, config):
        return True
    text = collection_path.read_text(encoding="utf-8")
    for term in str(config.option.markexpr).split(" and "):
        mark = term.removeprefix("not ")
        if mark == term and mark in ("plain", "real_time", "system") and mark not in text:
            return True
        if mark != term and re.search(rf"\npytestmark = \[?pytest\.mark\.{mark}\b", text):
            return True
    return None


def pytest_configure(config: pytest.Config) -> None:
    # numba reads it at import: this process has the kernels as plain Python, and programs that it starts compile. With
    # several processes the first runs no test, and the next ones inherit the value.
    if hasattr(config, "workerinput") or not config.getoption("numprocesses", None):
        os.environ.pop("NUMBA_DISABLE_JIT", None)
    config.pluginmanager.register(Patience(config.getoption("--put-off")))
    if file := config.getoption("--cpu-report"):
        config.pluginmanager.register(CpuReport(file))


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[object]:
    """Enable the garbage collector again without the imported objects: visiting them took a fifth of the CPU time."""
    result = yield
    gc.freeze()
    gc.set_threshold(50_000, 20, 20)
    gc.enable()
    return result


@pytest.hookimpl(tryfirst=True)  # before pytest selects by mark
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave all but some cases of tests marked `sampled` to `make test-all`; skip servo loops in plain Python."""
    items[:] = [item for item in items if is_in_part(item.path, config)]  # of files that the command line names
    sample_cases(items)
    skip_servo_loops(items)


def sample_cases(items: list[pytest.Item]) -> None:
    """Mark as `exhaustive` all cases but n, evenly spaced, of each test marked `sampled(n)`."""
    tests: dict[str, list[pytest.Item]] = {}
    for item in items:
        if item.get_closest_marker("sampled") and not item.get_closest_marker("exhaustive"):
            tests.setdefault(item.nodeid.partition("[")[0], []).append(item)
    for of_test in tests.values():
        (count,) = of_test[0].get_closest_marker("sampled").args
        chosen = {round((i + 0.5) * len(of_test) / count - 0.5) for i in range(count)}
        for i, item in enumerate(of_test):
            if i not in chosen:
                item.add_marker("exhaustive")


def skip_servo_loops(items: list[pytest.Item]) -> None:
    """Skip tests that run a servo loop, which needs machine code, if kernels are plain Python."""
    if "numba" not in sys.modules or not sys.modules["numba"].config.DISABLE_JIT:
        return
    for item in items:
        if item.get_closest_marker("real_time"):
            item.add_marker(pytest.mark.skip(reason="it runs a servo, and NUMBA_DISABLE_JIT is set"))


@pytest.fixture(scope="session")
def cases(pytestconfig: pytest.Config) -> Callable[[int, int], int]:
    """`cases(few, many)`: how many cases a test marked `scaled` takes, many with --exhaustive."""
    exhaustive = pytestconfig.getoption("--exhaustive")
    return lambda few, many: many if exhaustive else few


def merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """`base` with `changes` put in, table by table; None removes a key."""
    out = dict(base)
    for key, value in changes.items():
        if value is None:
            out.pop(key, None)
        elif isinstance(value, dict):
            out[key] = merged(out.get(key, {}), value)
        else:
            out[key] = value
    return out


def paper_mapping(
    *, table: dict[str, Any] | None = None, material: dict[str, Any] | None = None, **tables: Any
) -> dict[str, Any]:
    """Return the paper's plane with round numbers and no damping, changed table by table.

    `table` changes keys of the object, `material` those of its material, any other name a table of the scene; None
    removes one. There is no velocity filter, so that a tick depends on two poses only.
    """
    base_material = {
        "stiffness_n_per_m": 1000.0,
        "damping_ns_per_m": 0.0,
        "friction": {"static": 0.6, "kinetic": 0.5},
        "torsion": {"stiffness_nm_per_rad": 0.05, "friction_length_m": 0.004},
    }
    base = {
        "fingertip": {"radius_m": 0.01},
        "rolling": {"method": "euler_zxz"},
        "coupling": {"stiffness_n_per_m": 1000.0, "damping_ns_per_m": 0.0},
        "probe": {"velocity_time_constant_s": 0.0},
    }
    entry = merged({"name": "table", "shape": "plane"}, table or {})
    entry["material"] = merged(base_material, material or {})
    return {**merged(base, tables), "object": [entry]}


def paper_scene(**changes: Any) -> Scene:
    """Return the scene of `paper_mapping`."""
    return build(Scene, paper_mapping(**changes), "test scene")


@pytest.fixture(scope="module")
def endpoints(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, str]]:
    """Telemetry and commands of a daemon that replays the shipped recording on the paper's plane."""
    from softfinger.config.load import load_rig, load_scene
    from softfinger.server.app import Daemon

    folder = tmp_path_factory.mktemp("daemon")
    telemetry, commands = (f"ipc://{folder}/{name}" for name in ("telemetry", "commands"))
    rig = {"telemetry.endpoint": telemetry, "commands.endpoint": commands, "servo.realtime": "off"}
    with Daemon(load_rig("replay", rig), load_scene("paper-plane"), scene_name="paper-plane") as running:
        running.start()
        yield telemetry, commands
