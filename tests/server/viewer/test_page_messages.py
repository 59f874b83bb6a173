"""Corrupted messages of browsers: the page's process continues and serves the next browser."""

from __future__ import annotations

import asyncio
import os
import random
import subprocess
import sys
import time
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import urlopen

import msgpack
import pytest
import viser
from helpers.fuzzing import mutated
from helpers.pages import CAMERA
from helpers.programs import Program
from viser._messages import GuiUpdateMessage
from viser.infra._async_message_buffer import AsyncMessageBuffer
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

import softfinger.server.viewer.page  # noqa: F401 - it mends viser

pytestmark = pytest.mark.real_time

PAGE = """
import sys
from softfinger.server.viewer.page import Page
page = Page("127.0.0.1", 0)
page.add_views()
print(page.address, flush=True)
sys.stdin.readline()
page.close()
"""
SAID: list[dict[str, Any]] = [
    CAMERA,
    {"type": "GuiUpdateMessage", "uuid": "a", "updates": {"value": 1.0}},
    {"type": "ScenePointerMessage", "event_type": "click", "ray_origin": [0, 0, 1], "ray_direction": [0, 0, -1],
     "screen_pos": [[0.5, 0.5]]},
    {"type": "TransformControlsUpdateMessage", "name": "/a", "wxyz": [1, 0, 0, 0], "position": [0, 0, 0]},
    {"type": "ShareUrlDisconnect"},
]  # fmt: skip
"""Messages that viser's browser client sends."""
GROWTH_MAX_KB = 200_000
"""A Python process grows by some tens of MB in its first seconds; corrupted messages may not add memory."""


def resident_kb(pid: int) -> int:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024


def talk(address: str, messages: list[bytes]) -> None:
    where = urlsplit(address)
    with connect(
        f"ws://{where.netloc}{where.path}", origin=Origin(f"http://{where.netloc}"), compression=None, max_queue=None,
        subprotocols=[Subprotocol(f"viser-v{viser.__version__}")], max_size=None,
    ) as client:  # fmt: skip
        client.recv(timeout=60.0)
        try:
            for message in messages:
                client.send(message)
        except ConnectionClosed:
            return  # the page may close the connection


def test_a_browser_that_connects_while_a_message_is_queued_ends_nothing() -> None:
    """viser wakes browsers in one thread while another adds one: the message is queued and the event is set."""
    loop = asyncio.new_event_loop()
    buffer = AsyncMessageBuffer(loop, persistent_messages=True)
    waiters: Any = buffer.message_event._waiters

    class Connecting:
        def done(self) -> bool:
            waiters.append(self)
            return True

    waiters.append(Connecting())
    message = GuiUpdateMessage("a", {"value": 1.0})
    buffer.push(message)
    assert list(buffer.message_from_id.values()) == [message] and buffer.message_event.is_set()
    loop.call_soon(loop.stop)
    loop.run_forever()
    loop.close()


@pytest.mark.parametrize("seconds", [0.8, pytest.param(15.0, marks=pytest.mark.exhaustive)])
def test_corrupted_messages_do_not_harm_the_page(seconds: float, tmp_path: Path) -> None:
    seeds = [msgpack.packb(message) for message in SAID]
    chance = random.Random(25 if seconds < 5.0 else None)
    log = tmp_path / "said"
    with log.open("wb") as stderr, Program(
        [sys.executable, "-c", PAGE], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=stderr, text=True
    ) as page:  # fmt: skip
        assert page.stdout is not None
        address = page.stdout.readline().strip()
        try:
            talk(address, seeds)
            before, until = resident_kb(page.pid), time.monotonic() + seconds
            while time.monotonic() < until:
                talk(address, [seeds[0], *(mutated(seeds, chance) for _ in range(8))])
            assert page.poll() is None
            assert resident_kb(page.pid) - before < GROWTH_MAX_KB
            with urlopen(address, timeout=60.0) as answer:
                assert answer.status == 200
        finally:
            page.communicate("\n", timeout=60.0)
    assert page.returncode == 0
    assert "Traceback" not in log.read_text("utf-8"), log.read_text("utf-8")[-3000:]
