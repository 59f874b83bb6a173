"""The page as a process: its address, the secrecy of its token, and its restarts."""

import asyncio
import os
import random
import re
import shlex
import signal
import stat
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit
from urllib.request import url2pathname

import msgpack
import pytest
import viser
from helpers.browser import browser, eventually, shown, why_none
from helpers.fuzzing import mutated
from helpers.pages import CAMERA, is_served
from helpers.processes import COMMAND, find_child, has_exited, read_memory
from helpers.programs import Program
from helpers.waits import ends_within
from viser._messages import GuiUpdateMessage
from viser.infra._async_message_buffer import AsyncMessageBuffer
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Origin, Subprotocol

import softfinger.server.viewer.page  # noqa: F401 - it mends viser
from softfinger.server.viewer.door import process as of_page
from softfinger.server.viewer.door.process import RESTARTS, PageProcess
from softfinger.server.viewer.page import Page

pytestmark = pytest.mark.real_time

WAIT_S = 280.0
"""Limit of a test that hangs, below the five minutes after which tests/run.py ends all tests."""


def find_page(process: subprocess.Popen[str]) -> int:
    """Wait for the page's process."""
    return find_child(process.pid, b"\0view\0")


@contextmanager
def run_with_page(*more: str) -> Iterator[tuple[subprocess.Popen[str], str]]:
    ends = ["--endpoint", "tcp://127.0.0.1:*", "--commands", "tcp://127.0.0.1:*"]
    command = [*COMMAND, "run", "--realtime", "off", *ends, "--view", *more]
    with Program(command, stderr=subprocess.PIPE, text=True, process_group=0) as process:
        timer = threading.Timer(WAIT_S, os.killpg, (process.pid, signal.SIGKILL))
        timer.start()
        try:
            first = next(line for line in process.stderr if "compiling kernel" not in line)
            assert first.endswith("the page; to stop it: Ctrl-C\n")
            address = next(process.stderr)
            assert address.startswith("http://localhost:")
            yield process, address.rstrip()
        finally:
            timer.cancel()
            process.kill()


def test_a_page_that_ends_is_restarted_at_the_same_address() -> None:
    with run_with_page() as (process, address):
        page = find_page(process)
        assert urlsplit(address).path.strip("/") not in Path(f"/proc/{page}/cmdline").read_text()
        os.kill(page, signal.SIGKILL)
        ended = next(line for line in process.stderr if "the page has ended" in line)
        assert f"exit code -9; the servo continues; restart 1 of {RESTARTS}" in ended
        assert eventually(lambda: is_served(address)) and process.poll() is None
        pid = find_page(process)
        process.kill()
        assert eventually(lambda: has_exited(pid))


@pytest.fixture
def start_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], tuple[PageProcess, list[str]]]:
    """Return a function that starts a shell script instead of a page; it returns the process and its reports."""

    def start(script: str) -> tuple[PageProcess, list[str]]:
        program, reports = tmp_path / "python", list[str]()
        program.write_text(f"#!/bin/sh\n{script}\n")
        program.chmod(0o755)
        monkeypatch.setattr(sys, "executable", str(program))
        return PageProcess(f"ipc://{tmp_path}/t", f"ipc://{tmp_path}/c", [], reports.append), reports

    return start


def test_a_page_that_hangs_at_start_is_killed(start_page: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(of_page, "START_TIMEOUT_S", 0.2)
    page, reports = start_page("exec sleep 600")
    page.supervise()
    page.close()
    assert len(reports) == 1 and "the page has ended, with exit code -9" in reports[0]


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")  # the pipe of each crashed page, until collected
def test_a_page_that_crashes_repeatedly_restarts_three_times(start_page: Any) -> None:
    page, reports = start_page("echo http://localhost:1/secret/\nexit 3")
    assert eventually(lambda: page.supervise() or len(reports) > RESTARTS)
    page.supervise()
    page.close()
    last = r"with exit code 3; .*; (?:restart (\d) of 3|to see it again: .*view)"
    numbers = [re.search(last, text) for text in reports]
    assert [number and number[1] for number in numbers] == ["1", "2", "3", None]


def test_a_stopped_page_ends_with_the_daemon(start_page: Any) -> None:
    page, _ = start_page("echo http://localhost:1/secret/\nexec sleep 600")
    os.kill(page._process.pid, signal.SIGSTOP)
    page.close()
    assert page._process.returncode == -signal.SIGTERM


def test_a_browser_that_does_not_read_does_not_delay_the_end(monkeypatch: pytest.MonkeyPatch) -> None:
    page, read = Page("127.0.0.1", 0), threading.Event()
    stop = page.server.stop
    monkeypatch.setattr(page.server, "stop", lambda: read.wait() and stop())  # as viser waits for a browser
    with ends_within(60):
        page.close()
    read.set()


BROWSER = """#!/bin/sh
printf '%s\\n' "$@" > "{seen}/words.new"
mv "{seen}/words.new" "{seen}/words"
"""


def test_a_browser_opens_the_page_through_a_private_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    program = tmp_path / "browser"
    program.write_text(BROWSER.format(seen=tmp_path))
    program.chmod(0o755)
    monkeypatch.setenv("BROWSER", f"{shlex.quote(str(program))} %s")
    monkeypatch.setenv("DISPLAY", ":0")
    command = [*COMMAND, "view", "tap", "--port", "8320"]
    with Program([*command, "--print-address"], stdout=subprocess.PIPE, text=True, kill_at_end=True) as process:
        address = process.stdout.readline().strip()
        while not (tmp_path / "words").exists():
            assert process.poll() is None
            time.sleep(0.01)
        (word,) = (tmp_path / "words").read_text().splitlines()
        file = Path(url2pathname(urlsplit(word).path))
        assert urlsplit(address).path.strip("/") not in word
        assert stat.S_IMODE(file.stat().st_mode) == 0o600 and stat.S_IMODE(file.parent.stat().st_mode) == 0o700
        assert address in file.read_text()
        process.send_signal(signal.SIGINT)
        process.wait()
        assert not file.exists()


@pytest.mark.system
@pytest.mark.skipif(bool(why_none()), reason=why_none())
def test_an_open_browser_reconnects_to_a_restarted_page() -> None:
    with run_with_page() as (process, address), browser() as page:
        threading.Thread(target=process.communicate, daemon=True).start()  # reads stderr, so that it does not block
        screen = shown(page, address)

        def tick() -> int:
            match = re.search(r"tick (\d+)", screen.page.inner_text("body"))
            return int(match[1]) if match else -1

        assert eventually(lambda: tick() > 0)
        os.kill(find_page(process), signal.SIGKILL)
        before = tick()
        assert eventually(lambda: tick() > before + 2000)  # two seconds in real time


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
        address = page.stdout.readline().strip()
        try:
            talk(address, seeds)
            before, until = read_memory(page.pid), time.monotonic() + seconds
            while time.monotonic() < until:
                talk(address, [seeds[0], *(mutated(seeds, chance) for _ in range(8))])
            assert page.poll() is None and read_memory(page.pid) - before < 1024 * GROWTH_MAX_KB
            assert is_served(address)
        finally:
            page.communicate("\n", timeout=60.0)
    assert page.returncode == 0
    assert "Traceback" not in log.read_text("utf-8"), log.read_text("utf-8")[-3000:]
