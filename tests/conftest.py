"""Scenes for the tests, built from the same mappings a scene file holds."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from typing import Any

import pytest
from helpers.stalls import Patience
from hypothesis import settings

from softfinger.config.load import build
from softfinger.config.schema import Scene
from softfinger.drivers import opened

pytest_plugins = ["helpers.pages"]
collect_ignore = ["outside_driver"]
"""A package of its own, whose tests need it installed: tests/test_packaging.py runs them."""

settings.register_profile("full")  # tests/proxy/test_invariants.py says what it is
SceneFactory = Callable[..., Scene]

# A shell starts what it puts into the background with two of these ignored, nohup with the third. The program leaves it
# at that, and so would every one that a test starts to send it a signal.
for _number in (signal.SIGINT, signal.SIGQUIT, signal.SIGHUP):
    if signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, signal.default_int_handler if _number == signal.SIGINT else signal.SIG_DFL)


@pytest.fixture(autouse=True)
def _no_device_of_another_test() -> Iterator[None]:
    """A device that a test left hanging, so that somebody still holds it, is not stopped by the next one's program."""
    yield
    opened.devices.clear()


def pytest_configure(config: pytest.Config) -> None:
    config.pluginmanager.register(Patience())


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
    """The paper's plane with round numbers and no damping, changed table by table.

    `table` changes keys of the object, `material` those of its material, any other name a table of
    the scene; None removes one. No velocity filter, so that a tick depends on two poses alone.
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
    thing = merged({"name": "table", "shape": "plane"}, table or {})
    thing["material"] = merged(base_material, material or {})
    return {**merged(base, tables), "object": [thing]}


FILES_A_WORKER = 12
"""Files that one process of a parallel run takes, before another takes its place.

numba frees nothing that it has compiled: a kernel of one more type of scene stays with 25 to 35 MB, a file of tests
with up to 150 MB, and a process that took half of all files has grown to 2.5 GB. It starts anew in seconds.
"""


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Files to processes, as `--dist loadfile`, with processes that end after so many."""
    if config.getvalue("dist") != "loadfile":
        return None
    from xdist.scheduler import LoadFileScheduling

    class Recycling(LoadFileScheduling):  # type: ignore[misc]
        def remove_node(self, node: Any) -> str | None:
            """What a process that crashed has not done is handed on, but for the test that it crashed in. (As it comes,
            files that are done are handed on as well: who gets one has nothing to tell, and all wait for ever.)"""
            left = {file: tests for file, tests in self.assigned_work.pop(node).items() if not all(tests.values())}
            if not left:
                return None
            tests = next(iter(left.values()))
            crashed: str = next(test for test, done in tests.items() if not done)
            tests[crashed] = True
            self.workqueue.update({file: tests for file, tests in left.items() if not all(tests.values())})
            for other in self.assigned_work:
                self._reschedule(other)
            return crashed

        def _reschedule(self, node: Any) -> None:
            if node not in self.registered_collections:
                return  # it is starting: it asks again
            if self.workqueue and not node.shutting_down and len(self.assigned_work[node]) >= FILES_A_WORKER:
                node.shutdown()  # behind what it has been given
                config.pluginmanager.getplugin("dsession")._clone_node(node)
            else:
                super()._reschedule(node)

    return Recycling(config, log)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any, error: object) -> None:
    """A process that has done its files ends now: left to itself it would wait, with its memory, for the last one."""
    node.ensure_teardown()


@pytest.fixture
def plane_scene() -> SceneFactory:
    """Makes scenes of one plane: see `paper_mapping` for what can be changed."""

    def make(**changes: Any) -> Scene:
        return build(Scene, paper_mapping(**changes), "test scene")

    return make


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
