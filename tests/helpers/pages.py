"""Fixtures for test files with their own fixture `daemon`: its page in a browser, and a client."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from helpers.browser import Screen
    from softfinger.server.app import Daemon
    from softfinger.server.remote import Client


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
