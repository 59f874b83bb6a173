"""Fixtures for test files with their own fixture `daemon`: its page in a browser, and a client."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any
from urllib.error import URLError
from urllib.request import urlopen

import pytest

if TYPE_CHECKING:
    from helpers.browser import Screen
    from softfinger.config.schema import Scene
    from softfinger.server.app import Daemon
    from softfinger.server.remote import Client
    from softfinger.server.viewer.live import LivePage


LOCAL = {"telemetry.endpoint": "tcp://127.0.0.1:*", "commands.endpoint": "tcp://127.0.0.1:*", "servo.realtime": "off"}

CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [0.0, 0.0, 1.0], "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, 0.0, 1.0], "fov": 1.0, "near": 0.1, "far": 100.0, "image_height": 100, "image_width": 100,
}  # fmt: skip
"""First message of a browser; viser ignores messages before it."""


def is_served(address: str) -> bool:
    """Return True if a server answers with a page."""
    with suppress(URLError), urlopen(address, timeout=60.0) as answer:
        return bool(answer.status == 200)
    return False


def step_until(live: LivePage, condition: Callable[[], Any]) -> bool:
    """Step a page, which no thread steps, until a condition is true; return False if it is not in time."""
    from helpers.waits import eventually

    return bool(eventually(lambda: condition() or live.step(0.05), every_s=0.01))


def daemon_of(rig: str, scene: str) -> Callable[[], Iterator[Daemon]]:
    """Return the fixture of a daemon with a shipped rig and scene, for the tests of a file."""

    @pytest.fixture(scope="module")
    def daemon() -> Iterator[Daemon]:
        with running(rig, scene) as started:
            yield started

    return daemon


@contextmanager
def running(rig: str, scene: str | Scene, **changes: Any) -> Iterator[Daemon]:
    """Run a daemon on ports that the system chooses; `changes` are those of the rig, with __ for the dot."""
    from softfinger.config.load import load_rig, load_scene
    from softfinger.server.app import Daemon

    values = LOCAL | {key.replace("__", "."): value for key, value in changes.items()}
    name, loaded = (scene, load_scene(scene)) if isinstance(scene, str) else ("test", scene)
    with Daemon(load_rig(rig, values), loaded, scene_name=name) as daemon:
        daemon.start()
        yield daemon


@pytest.fixture(scope="module")
def screen(daemon: Daemon) -> Iterator[Screen]:
    """The page, once it shows that nothing is touched."""
    from helpers.browser import eventually, served

    with served("--endpoint", daemon.publisher.endpoint, "--commands", str(daemon.commands_endpoint)) as screen:
        assert eventually(lambda: screen.shows("free"))
        yield screen


@pytest.fixture
def client(daemon: Daemon) -> Iterator[Client]:
    """Client with long time limits: a scene may have to be compiled while a browser renders in software."""
    from softfinger.server.remote import Client

    with Client(daemon.publisher.endpoint, str(daemon.commands_endpoint), timeout_s=300.0) as client:
        yield client
